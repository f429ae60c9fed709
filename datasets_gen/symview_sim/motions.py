"""Pure functions that experts are made of. Each commutes with turning and mirroring the scene."""

from __future__ import annotations

import numpy as np

from lerobot_symview.camera import Array

MAX_STEP = 0.05  # metres per action and axis
MAX_TURN = np.pi / 4  # radians per action
# An expert turns while it descends rather than at once: who imitates it sees the angle that is left in every frame, not
# in the first alone, where it is hardest to see.
EXPERT_TURN = np.pi / 16
REACHED, REACHED_YAW = 0.01, 0.1  # metres per axis, radians


def nearest_turn(yaw_from: float, yaw_to: float, period: float) -> float:
    """Return the smallest turn from `yaw_from` that reaches `yaw_to` up to `period` (pi: gripper, pi/2: cube), rad."""
    return float((yaw_to - yaw_from + period / 2) % period - period / 2)


def step_towards(position: Array, goal: Array, turn: float) -> Array:
    """Return the motion (4,) dx, dy, dz, dyaw towards `goal` (3,) and through `turn`, no faster than an expert moves."""
    limits = np.array([MAX_STEP, MAX_STEP, MAX_STEP, EXPERT_TURN])
    return np.clip(np.append(np.asarray(goal) - position, turn), -limits, limits)


def is_there(position: Array, goal: Array, turn: float) -> bool:
    """Return whether the gripper is at `goal` (3,) and has no `turn` left to make, closely enough to grasp."""
    return bool((np.abs(np.asarray(goal) - position) < REACHED).all() and abs(turn) < REACHED_YAW)
