"""Grasping a cube and carrying it: what several experts share. All from the present state alone."""

from __future__ import annotations

import numpy as np

from lerobot_symview.geometry.camera import Array
from symview_sim.motions import MAX_STEP, nearest_turn, step_towards
from symview_sim.scene import Scene

OPEN, CLOSED = 1.0, 0.0
CLEARANCE = 0.1  # metres above an object at which the gripper travels
LIFT = np.array([0.0, 0.0, MAX_STEP, 0.0])


def grasp(scene: Scene, cube: int, from_above: bool) -> Array:
    """Return the action (5,) that approaches `cube`, turns with it, and closes with the motion that gets there.

    `from_above` descends only once the gripper is over the cube, where a straight way could hit something else.
    """
    position, yaw = scene.pose(cube)
    turn = nearest_turn(scene.arm.yaw, yaw, period=np.pi / 2)
    aside = np.abs(scene.arm.position[:2] - position[:2]).max()
    if from_above and aside > 0.02:
        motion, _ = step_towards(scene.arm.position, position + [0, 0, CLEARANCE], turn)
        return np.append(motion, OPEN)
    motion, arrives = step_towards(scene.arm.position, position, turn)
    return np.append(motion, CLOSED if arrives else OPEN)


def carry(scene: Scene, goal: Array, turn: float, travel_height: float) -> Array:
    """Return the action (5,) that brings what is held to `goal` (3,) and lets go with the motion that gets there.

    It rises to `travel_height` metres before it moves sideways, and comes down over the goal.
    """
    position = scene.arm.position
    aside = np.abs(position[:2] - goal[:2]).max()
    if aside < 0.015:
        motion, arrives = step_towards(position, goal, turn)
        return np.append(motion, OPEN if arrives else CLOSED)
    if position[2] < travel_height - 0.025:
        return np.append(LIFT, CLOSED)
    motion, _ = step_towards(position, np.array([*goal[:2], travel_height]), turn)
    return np.append(motion, CLOSED)
