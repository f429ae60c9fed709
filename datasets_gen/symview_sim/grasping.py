"""Grasping and carrying a cube, shared by several experts. Actions depend on the current state alone."""

from __future__ import annotations

import numpy as np

from lerobot_symview.geometry.camera import Array
from symview_sim.control import CLOSED, OPEN
from symview_sim.motions import motion_to, yaw_difference
from symview_sim.scene import Scene

CLEARANCE = 0.1  # metres above an object at which the gripper travels
LAST_ACTION = 0.05  # metres: the last action of a straight path to an object; a shorter one would begin beside it
LIFT = np.array([0.0, 0.0, CLEARANCE, 0.0])


def grasp(scene: Scene, cube: int, from_above: bool, faces: int | None = None) -> Array:
    """Return the action (5,) that approaches a cube, aligns the gripper's yaw, and closes on arrival.

    Args:
        scene: the simulator.
        cube: body id.
        from_above: whether to descend only once the gripper is above the cube. Use it where the straight path could
            collide with another object. Short actions always do so.
        faces: pair of the cube's faces to grasp it by: 0 those along its x axis, 1 along y; None the nearer pair.
    """
    position, yaw = scene.pose(cube)
    if faces is None:
        yaw_change = yaw_difference(scene.arm.yaw, yaw, period=np.pi / 2)
    else:
        yaw_change = yaw_difference(scene.arm.yaw, yaw + faces * np.pi / 2, period=np.pi)
    is_aside = np.abs(scene.arm.position[:2] - position[:2]).max() > 0.02 or abs(yaw_change) > np.pi / 4
    if (from_above or scene.control.step < LAST_ACTION) and is_aside:
        return np.append(motion_to(scene.arm.position, position + [0, 0, CLEARANCE], yaw_change), OPEN)
    motion = motion_to(scene.arm.position, position, yaw_change)
    return np.append(motion, CLOSED if scene.control.arrives(motion) else OPEN)


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
        motion = motion_to(position, goal, yaw_change)
        return np.append(motion, OPEN if scene.control.arrives(motion) else CLOSED)
    if position[2] < travel_height - 0.025:
        return np.append(LIFT, CLOSED)
    return np.append(motion_to(position, np.array([*goal[:2], travel_height]), yaw_change), CLOSED)
