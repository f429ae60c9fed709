"""A PyBullet world with a table at z = 0 and one arm over a workspace."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import pybullet_data

from lerobot_symview.camera import Array
from lerobot_symview.names import lookup
from lerobot_symview.workspace import Workspace
from symview_sim.bullet import connect, disconnect, pybullet
from symview_sim.robots import ROBOTS, Arm

GRAVITY = -9.81
SETTLE_STEPS = 50


class Scene:
    """One simulator, private to its owner: every call carries its client id, so scenes do not disturb each other.

    Args:
        robot: name in `ROBOTS`.
        workspace: where the task takes place.
    """

    def __init__(self, robot: str, workspace: Workspace):
        self.client: Any = connect()
        self.client.setAdditionalSearchPath(pybullet_data.getDataPath())
        self._disconnect = weakref.finalize(self, disconnect, self.client)
        self.workspace = workspace
        self._robot = lookup("robot", robot, ROBOTS)
        self.arm: Arm

    def reset(self, gripper_position: Array, gripper_yaw: float) -> None:
        """Empty the world and put the arm back, gripper open at `gripper_position` (3,) metres, world frame.

        Everything is loaded anew: a reset that reuses bodies leaves contact caches behind and is not repeatable.
        """
        self.client.resetSimulation()
        self.client.setGravity(0, 0, GRAVITY)
        ground = self.client.createMultiBody(0, self.client.createCollisionShape(pybullet.GEOM_PLANE))
        self.client.changeVisualShape(ground, -1, rgbaColor=[1, 1, 1, 0])
        self.arm = Arm(self.client, self._robot)
        self.arm.reset(gripper_position, gripper_yaw)

    def add_box(
        self, size: Array, mass: float, friction: float, color: tuple[float, float, float], position: Array, yaw: float
    ) -> int:
        """Add a box of `size` (3,) metres with its centre at `position` (3,); return its body id."""
        half_extents = (np.asarray(size) / 2).tolist()
        body = self.client.createMultiBody(
            mass,
            self.client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half_extents),
            self.client.createVisualShape(pybullet.GEOM_BOX, halfExtents=half_extents, rgbaColor=[*color, 1.0]),
            np.asarray(position).tolist(),
            self.client.getQuaternionFromEuler([0, 0, yaw]),
        )
        self.client.changeDynamics(body, -1, lateralFriction=friction)
        return int(body)

    def settle(self) -> None:
        """Let freshly placed objects come to rest."""
        for _ in range(SETTLE_STEPS):
            self.client.stepSimulation()

    def pose(self, body: int) -> tuple[Array, float]:
        """Return a body's position (3,) in metres and its yaw in radians."""
        position, orientation = self.client.getBasePositionAndOrientation(body)
        return np.array(position), float(self.client.getEulerFromQuaternion(orientation)[2])

    def close(self) -> None:
        """Disconnect from the simulator."""
        self._disconnect()
