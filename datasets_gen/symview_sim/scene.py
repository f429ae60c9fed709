"""A PyBullet simulation of a table at z = 0, one robot arm and a workspace."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
import pybullet_data

from lerobot_symview.geometry.camera import Array
from lerobot_symview.geometry.workspace import Workspace
from symview_sim.arm import Arm
from symview_sim.bullet import connect, disconnect, pybullet
from symview_sim.control import Control
from symview_sim.robots import RobotSpec
from symview_sim.shapes import Part, Vector

GRAVITY = -9.81
SETTLE_STEPS = 20  # few, because objects are placed at rest
SOLVER_ITERATIONS = 20  # Bullet's default of 50 takes twice as long, and the experts succeed as often
MARKING_HEIGHT = 0.001  # metres
DRAWER_MASS, DRAWER_FRICTION = 0.5, 1.0  # kg, N
REACH_MARGIN = 0.05  # metres

Color = tuple[float, float, float]


class Scene:
    """One PyBullet simulation. Scenes in one process are independent: every call passes the client's id.

    Args:
        robot: the robot arm.
        workspace: the working area of the task.
        control: the rate and the limits of the actions.
    """

    def __init__(self, robot: RobotSpec, workspace: Workspace, control: Control):
        self.client: Any = connect()
        self.client.setAdditionalSearchPath(pybullet_data.getDataPath())
        self._disconnect = weakref.finalize(self, disconnect, self.client)
        self.workspace, self.control = workspace, control
        self.client.setGravity(0, 0, GRAVITY)
        self.client.setPhysicsEngineParameter(numSolverIterations=SOLVER_ITERATIONS, deterministicOverlappingPairs=1)
        ground = self.client.createMultiBody(0, self.client.createCollisionShape(pybullet.GEOM_PLANE))
        self.client.changeVisualShape(ground, -1, rgbaColor=[1, 1, 1, 0])
        self.arm = Arm(self.client, robot, control)
        self.arm.pass_through(ground)  # no arm reaches under the table; the collision test takes a quarter of a step
        self._fixtures: int = self.client.getNumBodies()
        # The first simulation step leaves a state in the solver. After it, episodes are bit-identical in whatever order
        # they are simulated (test_env.py).
        self.client.stepSimulation()

    def reset(self, gripper_position: Array, gripper_yaw: float) -> None:
        """Remove all objects and put the open gripper at `gripper_position` (3,) metres, world frame.

        The arm stays loaded, because loading takes long. Tasks create new objects, because contact caches would remain
        if old ones were moved.
        """
        for index in reversed(range(self._fixtures, self.client.getNumBodies())):
            self.client.removeBody(self.client.getBodyUniqueId(index))
        self.arm.reset(gripper_position, gripper_yaw)

    def add_box(self, size: Vector, mass: float, friction: float, color: Color, position: Vector, yaw: float) -> int:
        """Add a box of `size` (3,) metres with its centre at `position` (3,) metres; return its body id.

        Mass in kg, friction coefficient, RGB colour in [0, 1], yaw in rad.
        """
        half_extents = [side / 2 for side in size]
        body = self.client.createMultiBody(
            mass,
            self.client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half_extents),
            self.client.createVisualShape(pybullet.GEOM_BOX, halfExtents=half_extents, rgbaColor=[*color, 1.0]),
            list(position),
            self.client.getQuaternionFromEuler([0, 0, yaw]),
        )
        self.client.changeDynamics(body, -1, lateralFriction=friction)
        return int(body)

    def add_marking(self, side: float, color: Color, place: Array) -> int:
        """Add a visible square of `side` metres, without contacts, centred at `place` (2,) metres; return its id."""
        half_extents = [side / 2, side / 2, MARKING_HEIGHT / 2]
        shape = self.client.createVisualShape(pybullet.GEOM_BOX, halfExtents=half_extents, rgbaColor=[*color, 1.0])
        return int(self.client.createMultiBody(0, -1, shape, [*np.asarray(place).tolist(), MARKING_HEIGHT / 2]))

    def add_compound(
        self, parts: Sequence[Part], mass: float, friction: float, color: Color, position: Vector, yaw: float
    ) -> int:
        """Add a rigid body made of `parts` with its origin at `position` (3,); return its body id."""
        collision, visual = self._shapes(parts, color)
        orientation = self.client.getQuaternionFromEuler([0, 0, yaw])
        body = self.client.createMultiBody(mass, collision, visual, list(position), orientation)
        self.client.changeDynamics(body, -1, lateralFriction=friction)
        return int(body)

    def add_drawer(
        self, cabinet: Sequence[Part], drawer: Sequence[Part], position: Vector, yaw: float, travel: float
    ) -> int:
        """Add a fixed cabinet whose drawer slides out along -x by up to `travel` metres; return its body id."""
        base_collision, base_visual = self._shapes(cabinet, (0.9, 0.9, 0.88))
        link_collision, link_visual = self._shapes(drawer, (0.35, 0.4, 0.5))
        body = self.client.createMultiBody(
            baseMass=0,
            baseCollisionShapeIndex=base_collision,
            baseVisualShapeIndex=base_visual,
            basePosition=list(position),
            baseOrientation=self.client.getQuaternionFromEuler([0, 0, yaw]),
            linkMasses=[DRAWER_MASS],
            linkCollisionShapeIndices=[link_collision],
            linkVisualShapeIndices=[link_visual],
            linkPositions=[[0, 0, 0]],
            linkOrientations=[[0, 0, 0, 1]],
            linkInertialFramePositions=[[0, 0, 0]],
            linkInertialFrameOrientations=[[0, 0, 0, 1]],
            linkParentIndices=[0],
            linkJointTypes=[pybullet.JOINT_PRISMATIC],
            linkJointAxis=[[-1, 0, 0]],
        )
        self.client.changeDynamics(body, 0, jointLowerLimit=0.0, jointUpperLimit=travel)
        self.client.setJointMotorControl2(body, 0, pybullet.VELOCITY_CONTROL, targetVelocity=0.0, force=DRAWER_FRICTION)
        return int(body)

    def settle(self) -> None:
        """Simulate until new objects have come to rest, 20 steps."""
        self.wait(SETTLE_STEPS)

    def wait(self, steps: int) -> None:
        """Simulate `steps` steps of 1/240 s."""
        for _ in range(steps):
            self.client.stepSimulation()

    def opening(self, cabinet: int) -> float:
        """Return the opening of a cabinet's drawer, metres."""
        return float(self.client.getJointState(cabinet, 0)[0])

    def touch(self, body: int, other: int) -> bool:
        """Return whether two bodies are in contact."""
        return bool(self.client.getContactPoints(body, other))

    def gap(self, body: int, other: int, longest: float) -> float:
        """Return the distance between two bodies' surfaces, at most `longest`, metres."""
        points = self.client.getClosestPoints(body, other, longest)
        return min((float(point[8]) for point in points), default=longest)

    def tilt(self, body: int) -> float:
        """Return the larger of a body's roll and pitch, radians."""
        _, orientation = self.client.getBasePositionAndOrientation(body)
        roll, pitch, _ = self.client.getEulerFromQuaternion(orientation)
        return float(max(abs(roll), abs(pitch)))

    def clip_to_workspace(self, place: Array) -> Array:
        """Return the point (2,) of the workspace nearest to `place` (2,)."""
        center, half = np.asarray(self.workspace.center), self.workspace.size / 2
        return np.clip(place, center - half, center + half)

    def within_reach(self, body: int) -> bool:
        """Return whether a body is over the workspace, with a margin of 5 cm, and has not fallen off the table."""
        position = self.pose(body)[0]
        inside = np.abs(position[:2] - self.workspace.center) < self.workspace.size / 2 + REACH_MARGIN
        return bool(inside.all() and -REACH_MARGIN < position[2] < self.workspace.height_limit + REACH_MARGIN)

    def _shapes(self, parts: Sequence[Part], color: Color) -> tuple[int, int]:
        """Return the collision and visual shapes of a body made of `parts`."""
        geometry = {
            "shapeTypes": [pybullet.GEOM_CYLINDER if part.is_cylinder else pybullet.GEOM_BOX for part in parts],
            "halfExtents": [[size / 2 for size in part.size] for part in parts],
            "radii": [part.size[0] / 2 for part in parts],
            "lengths": [part.size[2] for part in parts],
        }
        positions = [part.position for part in parts]
        orientations = [self.client.getQuaternionFromEuler(part.euler) for part in parts]
        collision = self.client.createCollisionShapeArray(
            **geometry, collisionFramePositions=positions, collisionFrameOrientations=orientations
        )
        visual = self.client.createVisualShapeArray(
            **geometry,
            visualFramePositions=positions,
            visualFrameOrientations=orientations,
            rgbaColors=[[*color, 1.0]] * len(parts),
        )
        return int(collision), int(visual)

    def pose(self, body: int) -> tuple[Array, float]:
        """Return a body's position (3,), world frame, metres, and its yaw, rad."""
        position, orientation = self.client.getBasePositionAndOrientation(body)
        return np.array(position), float(self.client.getEulerFromQuaternion(orientation)[2])

    def close(self) -> None:
        """End the simulation."""
        self._disconnect()
