"""A scripted expert that lifts the cube, by inverse kinematics of the joints."""

from __future__ import annotations

import numpy as np

from lerobot_symview.geometry.camera import Array
from lerobot_symview.kinematics import ArmModel, solve
from lerobot_symview.kinematics.pose import tool_poses, wrapped
from symview_sim.so101.world import OPEN, So101World

TILT = 0.15  # radians of the fingers off straight down, outwards, so that all places can be reached
HOVER, GRASP, RAISED = 0.085, 0.018, 0.1  # heights of the fingers over the table, metres
STEP, TURN = 0.02, 0.2  # metres and radians in one action, at most
NEAR, ALIGNED = 0.008, 0.12  # metres and radians from the cube, at which the gripper goes down


class So101Expert:
    """Hovers over the cube, turns to the nearest of its faces, goes down, closes, and lifts.

    Each of its actions follows from what is there now, so it recovers from what went wrong.

    Args:
        world: what it acts in.
        arm: the arm's model, whose tool is the middle between the fingers.
    """

    def __init__(self, world: So101World, arm: ArmModel):
        self._world, self._arm = world, arm

    def action(self) -> Array:
        """Return the motors' targets (6,): degrees, and per cent for the gripper."""
        present = np.deg2rad(self._world.joints()[:5])
        pose = tool_poses(self._arm.forward(present[None]), self._arm.pivot)[0]
        target, opening = self._goal(pose)
        way = target - pose
        way[:3] *= min(1.0, STEP / max(float(np.linalg.norm(way[:3])), 1e-9))
        way[3:] = np.clip(way[3:], -TURN, TURN)
        joints = solve(self._arm, present, pose + way).positions
        return np.append(np.rad2deg(joints), opening) + self._world.droop()

    def _goal(self, pose: Array) -> tuple[Array, float]:
        """Return where the gripper should be (6,), as `tool_poses` says it, and the gripper's opening, per cent."""
        cube, yaw = self._world.cube()
        turn = wrapped(np.array(yaw - pose[3]), np.pi / 2)
        distance = np.linalg.norm(pose[:2] - cube[:2])
        goal = np.array([*cube[:2], HOVER, pose[3] + turn, TILT, pose[5]])
        if self._world.is_gripped():
            goal[:3] = [*pose[:2], RAISED]
            return goal, 0.0
        is_open = self._world.joints()[5] > OPEN - 10 or pose[2] < GRASP + 0.02  # in which it may close again
        if distance < NEAR and abs(turn) < ALIGNED and is_open:
            goal[2] = GRASP
            if pose[2] < GRASP + 0.006:
                return goal, 0.0
        return goal, OPEN
