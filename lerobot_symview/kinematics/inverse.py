"""Inverse kinematics: joint positions near the present ones that bring a tool to a pose, within the limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.kinematics.model import ArmModel, Array
from lerobot_symview.kinematics.pose import differences, tool_poses

ANGLE_WEIGHT = 0.1  # metres that count as much as a radian
EXACT = 1e-7  # metres, and radians times their weight, of a solution that needs no further iteration
STALLED = 1e-6  # relative decrease of the error at which it is at its least
DIFFERENCE = 1e-6  # of a joint, for derivatives
Unreachable = Literal["hold", "error"]
UNREACHABLE: tuple[Unreachable, ...] = ("hold", "error")  # what a robot may do where no solution is near enough
LONGEST = 0.3  # radians or metres of a joint per iteration


@dataclass(frozen=True, eq=False)
class Solution:
    """Joint positions, and how far they are from what was asked for.

    Args:
        positions: (J,) radians and metres.
        distance: of the tool from its target, metres.
        angle: largest error of yaw, tilt and, of arms with six joints or more, lean, radians.
    """

    positions: Array
    distance: float
    angle: float


def solve(model: ArmModel, start: NDArray[np.floating], target: Array, iterations: int = 40) -> Solution:
    """Return joint positions for a target, found from the present ones by damped least squares.

    Where the target is out of reach, the error is at its least, or what `iterations` achieve; metres count more than
    angles.

    Args:
        model: the arm.
        start: (J,) present positions; outside the limits, the nearest within them.
        target: (6,) as `tool_poses` returns it; an arm of five joints does not follow the lean.
        iterations: most steps.
    """
    count = len(model.joints)
    used = 6 if count > 5 else 5
    weights = np.array([1.0, 1.0, 1.0, ANGLE_WEIGHT, ANGLE_WEIGHT, ANGLE_WEIGHT])[:used]
    shifts = np.concatenate([np.zeros((1, count)), DIFFERENCE * np.eye(count)])

    def errors(positions: Array) -> Array:
        poses = tool_poses(model.forward(positions + shifts), model.pivot)
        return differences(poses, target)[:, :used] * weights

    positions = np.clip(np.asarray(start, dtype=np.float64), model.lower, model.upper)
    found, damping = errors(positions), 1e-9
    for _ in range(iterations):
        residual = found[0]
        cost = residual @ residual
        if np.abs(residual).max() < EXACT:
            break
        jacobian = (found[1:] - residual).T / DIFFERENCE
        gradient = jacobian.T @ residual
        # a joint at its limit that would have to go beyond it does not take part
        stuck = ((positions <= model.lower) & (gradient > 0)) | ((positions >= model.upper) & (gradient < 0))
        jacobian[:, stuck] = 0.0
        matrix = jacobian.T @ jacobian + damping * np.eye(count)
        step = np.linalg.solve(matrix, -jacobian.T @ residual)
        step *= min(1.0, LONGEST / max(float(np.abs(step).max()), 1e-12))
        tried = np.clip(positions + step, model.lower, model.upper)
        found_there = errors(tried)
        cost_there = found_there[0] @ found_there[0]
        if cost_there < cost:
            positions, found, damping = tried, found_there, max(damping * 0.1, 1e-10)
            if cost - cost_there < STALLED * cost:
                break
        elif damping > 1.0:
            break
        else:
            damping = max(damping * 100, 1e-6)
    residual = found[0] / weights
    return Solution(positions, float(np.linalg.norm(residual[:3])), float(np.abs(residual[3:]).max()))
