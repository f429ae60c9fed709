"""Robot arms with parallel grippers, driven by Cartesian targets in a fixed number of simulation steps."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lerobot_symview.camera import Array
from symview_sim.bullet import pybullet

ARM_STEPS, GRIPPER_STEPS = 60, 25  # simulation steps at 1/240 s: 0.35 s an action
RAMP_STEPS = 40  # of the arm's steps, in which its target moves to the goal; it settles in the others
POSITION_GAIN = 0.2
# Steel on wood. Grippier fingers jam on a cube's corners instead of turning it into line: at 1.0 a cube held 35 degrees
# askew stays so, at 0.2 it slips out.
FINGER_FRICTION = 0.3
IK_ITERATIONS, IK_RESIDUAL = 200, 1e-6


@dataclass(frozen=True)
class RobotSpec:
    """What distinguishes one robot model from another; asset paths are those of `pybullet_data`.

    Args:
        urdf: model file.
        base: position of the base, metres.
        home: joint angles of the arm that start the search for a posture, rad.
        hand_link: link whose frame is the point between the fingertips.
        finger_links: the two finger links, whose joints move by up to `finger_travel` metres each.
        finger_yaw: angle from the fingers' opening axis to the hand frame's x axis, rad.
        arm_force: motor limit of an arm joint, N m.
        finger_force: motor limit of a finger, N.
        color: RGBA of the arm; the fingers are drawn darker.
    """

    urdf: str
    base: tuple[float, float, float]
    home: tuple[float, ...]
    hand_link: int
    finger_links: tuple[int, int]
    finger_travel: float
    finger_yaw: float
    arm_force: float
    finger_force: float
    color: tuple[float, float, float, float] = (0.93, 0.93, 0.95, 1.0)
    finger_color: tuple[float, float, float, float] = (0.25, 0.25, 0.28, 1.0)


ROBOTS = {
    "panda": RobotSpec(
        urdf="franka_panda/panda.urdf",
        base=(-0.1, 0.0, 0.0),
        home=(0.0, 0.1, 0.0, -2.2, 0.0, 2.3, 0.785),
        hand_link=11,
        finger_links=(9, 10),
        finger_travel=0.04,
        finger_yaw=np.pi / 2,
        arm_force=240.0,
        finger_force=10.0,
    ),
}


class Arm:
    """A robot in one PyBullet client. Yaw 0 opens the fingers along world x; yaw is kept in [-pi/2, pi/2)."""

    def __init__(self, client: Any, spec: RobotSpec):
        self._client = client
        self._spec = spec
        # The collision meshes are drawn in place of the visual ones: 3.5k triangles for 100k, nine tenths of the time.
        self.body = client.loadURDF(spec.urdf, spec.base, useFixedBase=True, flags=pybullet.URDF_IGNORE_VISUAL_SHAPES)
        self._joints = list(range(len(spec.home)))
        for finger in spec.finger_links:
            client.changeDynamics(
                self.body,
                finger,
                lateralFriction=FINGER_FRICTION,
                spinningFriction=0.1,
                contactStiffness=3e4,
                contactDamping=1e3,
            )
        self._paint(1.0)

    def reset(self, position: ArrayLike, yaw: float) -> None:
        """Place the gripper, open, at `position` (3,) metres, world frame, without simulating the way there."""
        for joint, angle in zip(self._joints, self._spec.home, strict=True):
            self._client.resetJointState(self.body, joint, angle)
        for finger in self._spec.finger_links:
            self._client.resetJointState(self.body, finger, self._spec.finger_travel)
        for joint, angle in zip(self._joints, self._solve(position, yaw), strict=True):
            self._client.resetJointState(self.body, joint, angle)
        self._command_arm(self._solve(position, yaw))
        self._command_fingers(1.0)

    def move(self, position: ArrayLike, yaw: float, aperture: float) -> None:
        """Move the gripper to `position` (3,), `yaw`, then open it to `aperture` in [0, 1]; always as many steps."""
        simulate = self._client.stepSimulation
        start = np.array([state[0] for state in self._client.getJointStates(self.body, self._joints)])
        goal = np.array(self._solve(position, yaw))
        progress = np.arange(1, RAMP_STEPS + 1)[:, None] / RAMP_STEPS
        for angles in (start + (goal - start) * progress).tolist():  # a target that jumps would throw what it hits
            self._command_arm(angles)
            simulate()
        for _ in range(ARM_STEPS - RAMP_STEPS):
            simulate()
        self._command_fingers(aperture)
        for _ in range(GRIPPER_STEPS):
            simulate()

    @property
    def position(self) -> Array:
        """(3,) the point between the fingertips, world frame, metres."""
        return np.array(self._hand_state()[4])

    @property
    def yaw(self) -> float:
        """Direction of the fingers' opening axis in [-pi/2, pi/2), rad."""
        rotation = np.reshape(self._client.getMatrixFromQuaternion(self._hand_state()[5]), (3, 3))
        heading = np.arctan2(rotation[1, 0], rotation[0, 0]) - self._spec.finger_yaw
        return float((heading + np.pi / 2) % np.pi - np.pi / 2)

    @property
    def aperture(self) -> float:
        """How far the gripper is open, 0 to 1."""
        states = self._client.getJointStates(self.body, self._spec.finger_links)
        return float(np.clip(sum(state[0] for state in states) / (2 * self._spec.finger_travel), 0.0, 1.0))

    def holds(self, body: int) -> bool:
        """Whether both fingers press on `body` from opposite sides."""
        normals = []
        for finger in self._spec.finger_links:
            contacts = self._client.getContactPoints(self.body, body, finger, -1)
            pushes = [np.array(contact[7]) for contact in contacts if contact[9] > 0]
            if not pushes:
                return False
            normals.append(np.mean(pushes, axis=0))
        return bool(normals[0] @ normals[1] < -0.5)

    @contextmanager
    def hidden(self) -> Iterator[None]:
        """Leave the arm out of what is rendered meanwhile."""
        self._paint(0.0)
        try:
            yield
        finally:
            self._paint(1.0)

    def _paint(self, alpha: float) -> None:
        for link in range(-1, self._client.getNumJoints(self.body)):
            color = self._spec.finger_color if link in self._spec.finger_links else self._spec.color
            self._client.changeVisualShape(self.body, link, rgbaColor=[*color[:3], alpha])

    def _hand_state(self) -> Any:
        return self._client.getLinkState(self.body, self._spec.hand_link, computeForwardKinematics=True)

    def _solve(self, position: ArrayLike, yaw: float) -> list[float]:
        orientation = self._client.getQuaternionFromEuler([np.pi, 0.0, yaw + self._spec.finger_yaw])
        solution = self._client.calculateInverseKinematics(
            self.body,
            self._spec.hand_link,
            np.asarray(position, dtype=np.float64).tolist(),
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
            self._spec.finger_links,
            pybullet.POSITION_CONTROL,
            targetPositions=[aperture * self._spec.finger_travel] * 2,
            forces=[self._spec.finger_force] * 2,
        )
