"""Pure functions that experts are made of. Each commutes with turning and mirroring the scene."""

from __future__ import annotations

import numpy as np

from lerobot_symview.geometry.camera import Array

MAX_STEP = 0.05  # metres per action and axis
MAX_TURN = np.pi / 4  # radians per action
ALIGNED_YAW = 0.1  # radians


def nearest_turn(yaw_from: float, yaw_to: float, period: float) -> float:
    """Return the smallest turn from `yaw_from` that reaches `yaw_to` up to `period` (pi: gripper, pi/2: cube), rad."""
    return float((yaw_to - yaw_from + period / 2) % period - period / 2)


def step_towards(position: Array, goal: Array, turn: float) -> tuple[Array, bool]:
    """Return the motion (4,) dx, dy, dz, dyaw towards `goal` (3,) and through `turn`, and whether it gets there."""
    limits = np.array([MAX_STEP, MAX_STEP, MAX_STEP, MAX_TURN])
    motion = np.append(np.asarray(goal) - position, turn)
    return np.clip(motion, -limits, limits), bool((np.abs(motion) <= limits).all())


def _straight(way: Array, longest: float) -> Array:
    """Shorten a horizontal `way` (2,) to at most `longest` metres per axis without changing its direction."""
    return way * min(1.0, longest / max(np.abs(way).max(), 1e-9))


def sweep(position: Array, yaw: float, start: Array, end: Array, height: float, speed: float = MAX_STEP) -> Array:
    """Return the motion (4,) of a sweep along the table from `start` to `end` (2,), approached from above `start`.

    What to do follows from where the gripper is: on the line and low, go on to `end`; above `start`, go down; else go
    to 10 cm above `start`. The fingers' opening axis is kept across the sweep, whose steps are at most `speed` metres.
    """
    along = (end - start) / np.linalg.norm(end - start)
    turn = nearest_turn(yaw, np.arctan2(along[0], -along[1]), period=np.pi)
    offset = position[:2] - start
    ahead, aside = offset @ along, abs(offset @ np.array([-along[1], along[0]]))
    is_low = position[2] < height + 0.015
    if is_low and aside < 0.02 and ahead > -0.02:
        motion, _ = step_towards(position, np.array([*end, height]), turn)
        motion[:2] = _straight(end - position[:2], speed)
        return motion
    is_above = np.abs(offset).max() < 0.015 and abs(turn) < ALIGNED_YAW
    return step_towards(position, np.array([*start, height if is_above else height + 0.1]), turn)[0]
