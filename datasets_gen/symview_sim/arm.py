"""A robot arm with a parallel gripper. Each Cartesian target takes a fixed number of simulation steps."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lerobot_symview.geometry.camera import Array
from symview_sim.bullet import pybullet, silenced
from symview_sim.control import Control
from symview_sim.motions import yaw_difference
from symview_sim.robots import RobotSpec

POSITION_GAIN = 0.2
# Steel on wood. With more friction the fingers jam on a cube's corners instead of aligning it: at 1.0 a cube grasped 35
# degrees askew stays askew, at 0.2 it slips out.
FINGER_FRICTION = 0.3
# The residual of 0 enforces all iterations. Otherwise Bullet stops as soon as the position is right, whatever the
# orientation, and a rotation in place then ends 14 cm away.
IK_ITERATIONS, IK_RESIDUAL = 150, 0.0
IDENTITY = (0.0, 0.0, 0.0, 1.0)  # quaternion


def _load(client: Any, spec: RobotSpec) -> int:
    """Load a robot with its base fixed; return its body id."""
    if spec.model.endswith(".sdf"):
        (body,) = client.loadSDF(spec.model)
        center_of_mass, _ = client.getBasePositionAndOrientation(body)
        client.resetBasePositionAndOrientation(body, np.add(center_of_mass, spec.base).tolist(), IDENTITY)
        return int(body)
    # Bullet then renders the collision meshes, 3.5k triangles instead of 100k, which saves nine tenths of the time.
    # Merging links that are fixed to each other saves a third of a simulation step.
    flags = pybullet.URDF_IGNORE_VISUAL_SHAPES | pybullet.URDF_MERGE_FIXED_LINKS
    with silenced():  # loadURDF prints every link
        return int(client.loadURDF(spec.model, spec.base, useFixedBase=True, flags=flags))


class Arm:
    """A robot in one PyBullet client. At yaw 0 the fingers open along world x; yaw is in [-pi/2, pi/2)."""

    def __init__(self, client: Any, spec: RobotSpec, control: Control):
        self._client = client
        self._spec = spec
        self._control = control
        self.body = _load(client, spec)
        self._joints = list(range(len(spec.home)))
        self._gripper_joints = list(spec.gripper_joints)
        self._closed, self._open, self._gripper_forces = np.array(list(spec.gripper_joints.values())).T
        for joint, (lower, upper) in spec.joint_limits.items():
            client.changeDynamics(self.body, joint, jointLowerLimit=lower, jointUpperLimit=upper)
        for finger in chain(*spec.finger_links):
            client.changeDynamics(
                self.body,
                finger,
                lateralFriction=FINGER_FRICTION,
                spinningFriction=0.1,
                contactStiffness=3e4,
                contactDamping=1e3,
            )
        self._wrist_limits = client.getJointInfo(self.body, self._joints[-1])[8:10]
        self._paint(1.0)

    def pass_through(self, body: int) -> None:
        """Disable collisions between `body` and the arm, except for the gripper. This saves collision tests."""
        for link in (-1, *self._joints):
            self._client.setCollisionFilterPair(self.body, body, link, -1, 0)

    def reset(self, position: ArrayLike, yaw: float) -> None:
        """Set the joints so that the open gripper is at `position` (3,) metres, world frame, and `yaw`, rad."""
        for joint, angle in zip(self._joints, self._spec.home, strict=True):
            self._client.resetJointState(self.body, joint, angle)
        for joint, angle in zip(self._gripper_joints, self._open, strict=True):
            self._client.resetJointState(self.body, joint, angle)
        for joint, angle in zip(self._joints, self._solve(position, yaw), strict=True):
            self._client.resetJointState(self.body, joint, angle)
        self._command_arm(self._solve(position, yaw))
        self._command_fingers(1.0)

    def move(self, position: ArrayLike, yaw: float, aperture: float) -> None:
        """Move the gripper to `position` (3,) metres and `yaw`, rad, then open it to `aperture` in [0, 1].

        The number of simulation steps is always the control's.
        """
        simulate = self._client.stepSimulation
        start = np.array([state[0] for state in self._client.getJointStates(self.body, self._joints)])
        goal = np.array(self._solve(position, yaw))
        ramp = self._control.ramp_steps
        progress = np.arange(1, ramp + 1)[:, None] / ramp
        for angles in (start + (goal - start) * progress).tolist():  # a sudden target would throw objects in the way
            self._command_arm(angles)
            simulate()
        for _ in range(self._control.hold_steps):
            simulate()
        self._command_fingers(aperture)
        for _ in range(self._control.finger_steps):
            simulate()

    @property
    def position(self) -> Array:
        """(3,) the point between the fingertips, world frame, metres."""
        hand = self._hand_state()
        return np.array(hand[4]) + self._rotation(hand[5]) @ self._spec.hand_from_tool

    @property
    def yaw(self) -> float:
        """Angle of the fingers' opening axis about z, in [-pi/2, pi/2), rad."""
        return float((self.heading + np.pi / 2) % np.pi - np.pi / 2)

    @property
    def aperture(self) -> float:
        """Opening of the gripper in [0, 1]: 0 closed, 1 open."""
        states = self._client.getJointStates(self.body, self._gripper_joints)
        travel, moved = self._open - self._closed, np.array([state[0] for state in states]) - self._closed
        return float(np.clip(moved @ travel / (travel @ travel), 0.0, 1.0))

    @property
    def is_finite(self) -> bool:
        """Whether the positions and velocities of all joints are finite numbers."""
        states = self._client.getJointStates(self.body, [*self._joints, *self._gripper_joints])
        return bool(np.isfinite([state[:2] for state in states]).all())

    def holds(self, body: int) -> bool:
        """Whether both fingers press on `body` from opposite sides."""
        normals = []
        for finger in self._spec.finger_links:
            contacts = chain(*(self._client.getContactPoints(self.body, body, link, -1) for link in finger))
            pushes = [np.array(contact[7]) for contact in contacts if contact[9] > 0]
            if not pushes:
                return False
            normals.append(np.mean(pushes, axis=0))
        return bool(normals[0] @ normals[1] < -0.5)

    @contextmanager
    def hidden(self) -> Iterator[None]:
        """Render images without the arm inside the context."""
        self._paint(0.0)
        try:
            yield
        finally:
            self._paint(1.0)

    def _paint(self, alpha: float) -> None:
        gripper = {*self._gripper_joints, *chain(*self._spec.finger_links)}
        for link in range(-1, self._client.getNumJoints(self.body)):
            color = self._spec.finger_color if link in gripper else self._spec.color
            self._client.changeVisualShape(self.body, link, rgbaColor=[*color[:3], alpha])

    def _hand_state(self) -> Any:
        return self._client.getLinkState(self.body, self._spec.hand_link, computeForwardKinematics=True)

    @property
    def heading(self) -> float:
        """Yaw modulo 2 pi, which distinguishes the two fingers, rad."""
        rotation = self._rotation(self._hand_state()[5])
        return float(np.arctan2(rotation[1, 0], rotation[0, 0])) - self._spec.finger_yaw

    def _rotation(self, quaternion: Any) -> Array:
        return np.reshape(self._client.getMatrixFromQuaternion(quaternion), (3, 3))

    def _solve(self, position: ArrayLike, yaw: float) -> list[float]:
        """Return the joint angles, rad, that bring the gripper to `position` (3,) metres and to `yaw` modulo pi."""
        heading = self.heading
        yaw_change = yaw_difference(heading, yaw, period=np.pi)
        lower, upper = self._wrist_limits
        # If the shorter rotation exceeds the wrist's limits, rotate in the opposite direction.
        for half_turn in (0.0, -np.copysign(np.pi, yaw_change)):
            *arm, wrist = self._inverse_kinematics(position, heading + yaw_change + half_turn)
            wrist = (wrist + np.pi) % (2 * np.pi) - np.pi
            if lower <= wrist <= upper:
                break
        return [*arm, wrist]

    def _inverse_kinematics(self, position: ArrayLike, heading: float) -> list[float]:
        orientation = self._client.getQuaternionFromEuler([np.pi, 0.0, heading + self._spec.finger_yaw])
        hand = np.asarray(position, dtype=np.float64) - self._rotation(orientation) @ self._spec.hand_from_tool
        solution = self._client.calculateInverseKinematics(
            self.body,
            self._spec.hand_link,
            hand.tolist(),
            orientation,
            maxNumIterations=IK_ITERATIONS,
            residualThreshold=IK_RESIDUAL,
        )
        return list(solution[: len(self._joints)])

    def _command_arm(self, angles: list[float]) -> None:
        count = len(self._joints)
        self._client.setJointMotorControlArray(
            self.body,
            self._joints,
            pybullet.POSITION_CONTROL,
            targetPositions=angles,
            forces=[self._spec.arm_force] * count,
            positionGains=[POSITION_GAIN] * count,
        )

    def _command_fingers(self, aperture: float) -> None:
        self._client.setJointMotorControlArray(
            self.body,
            self._gripper_joints,
            pybullet.POSITION_CONTROL,
            targetPositions=(self._closed + aperture * (self._open - self._closed)).tolist(),
            forces=self._gripper_forces.tolist(),
        )
