"""Grasping and carrying a cube, shared by several experts. Actions depend on the current state alone."""

from __future__ import annotations

import numpy as np

from lerobot_symview.geometry.camera import Array
from symview_sim.motions import MAX_STEP, step_towards, yaw_difference
from symview_sim.scene import Scene

OPEN, CLOSED = 1.0, 0.0
CLEARANCE = 0.1  # metres above an object at which the gripper travels
LIFT = np.array([0.0, 0.0, MAX_STEP, 0.0])


def grasp(scene: Scene, cube: int, from_above: bool) -> Array:
    """Return the action (5,) that approaches a cube, aligns the gripper's yaw, and closes on arrival.

    Args:
        scene: the simulator.
        cube: body id.
        from_above: whether to descend only once the gripper is above the cube. Use it where the straight path could
            collide with another object.
    """
    position, yaw = scene.pose(cube)
    yaw_change = yaw_difference(scene.arm.yaw, yaw, period=np.pi / 2)
    aside = np.abs(scene.arm.position[:2] - position[:2]).max()
    if from_above and aside > 0.02:
        motion, _ = step_towards(scene.arm.position, position + [0, 0, CLEARANCE], yaw_change)
        return np.append(motion, OPEN)
    motion, arrives = step_towards(scene.arm.position, position, yaw_change)
    return np.append(motion, CLOSED if arrives else OPEN)


def carry(scene: Scene, goal: Array, yaw_change: float, travel_height: float) -> Array:
    """Return the action (5,) that carries the grasped object to `goal` and releases it on arrival.

    The gripper rises to `travel_height` before it moves sideways, and descends above the goal.

    Args:
        scene: the simulator.
        goal: (3,) position of the gripper, world frame, metres.
        yaw_change: rotation about z that remains to be done, rad.
        travel_height: metres.
    """
    position = scene.arm.position
    aside = np.abs(position[:2] - goal[:2]).max()
    if aside < 0.015:
        motion, arrives = step_towards(position, goal, yaw_change)
        return np.append(motion, OPEN if arrives else CLOSED)
    if position[2] < travel_height - 0.025:
        return np.append(LIFT, CLOSED)
    motion, _ = step_towards(position, np.array([*goal[:2], travel_height]), yaw_change)
    return np.append(motion, CLOSED)
