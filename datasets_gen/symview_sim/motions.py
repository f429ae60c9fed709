"""Pure functions that experts are made of. Each commutes with turning and mirroring the scene."""

from __future__ import annotations

import numpy as np

from lerobot_symview.camera import Array

MAX_STEP = 0.05  # metres per action and axis
MAX_TURN = np.pi / 4  # radians per action


def nearest_turn(yaw_from: float, yaw_to: float, period: float) -> float:
    """Return the smallest turn from `yaw_from` that reaches `yaw_to` up to `period` (pi: gripper, pi/2: cube), rad."""
    return float((yaw_to - yaw_from + period / 2) % period - period / 2)


def step_towards(position: Array, goal: Array, turn: float) -> tuple[Array, bool]:
    """Return the motion (4,) dx, dy, dz, dyaw towards `goal` (3,) within the limits, and whether it arrives."""
    motion = np.append(np.asarray(goal) - position, turn)
    limits = np.array([MAX_STEP, MAX_STEP, MAX_STEP, MAX_TURN])
    return np.clip(motion, -limits, limits), bool((np.abs(motion) <= limits).all())
