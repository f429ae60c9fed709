"""How a gripper is controlled: rate, size and duration of its actions. Importing it does not import PyBullet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lerobot_symview.geometry.camera import Array

OPEN, CLOSED = 1.0, 0.0  # apertures
LOOK_AHEAD = 0.3  # seconds


@dataclass(frozen=True)
class Control:
    """The rate and the limits of actions, the speed of the experts, and the simulation steps of an action.

    Args:
        actions_per_second: of the robot.
        max_steps: actions per episode, unless the settings give another number.
        step: largest motion of an action per axis, metres.
        yaw_step: largest rotation of an action, rad.
        speed: of the experts per axis, metres per second; at most `step` in an action.
        arrival: largest remaining motion per axis, metres, and rotation, rad, at which the experts close or open the
            gripper. The fingers move after the arm, so a control whose actions cover this distance may act at once.
        ramp_steps: simulation steps of 1/240 s in which the joint targets reach the goal.
        hold_steps: steps after them in which the arm settles.
        finger_steps: steps after those in which the fingers move.
    """

    actions_per_second: int
    max_steps: int
    step: float
    yaw_step: float
    speed: float
    arrival: tuple[float, float]
    ramp_steps: int
    hold_steps: int
    finger_steps: int

    def step_at(self, speed: float, by_hand: bool = False) -> float:
        """Return the motion in one action at `speed`, metres per second, or at the experts' speed if that is lower.

        A hand (`human_style`) follows a goal that runs ahead of it: then, the motion in the time that it plans ahead.
        """
        least = min(speed, self.speed)
        return least * LOOK_AHEAD if by_hand else least / self.actions_per_second

    @property
    def limits(self) -> Array:
        """(4,) the largest dx, dy, dz, metres, and dyaw, rad, of an action."""
        return np.array([self.step, self.step, self.step, self.yaw_step])

    def planned(self, action: Array) -> Array:
        """Shorten an action (5,), whose motion may be longer than one action, to the experts' speed."""
        largest = np.append(np.full(3, self.step_at(self.speed)), self.yaw_step)
        return np.append(np.clip(action[:4], -largest, largest), action[4])

    def arrives(self, motion: Array) -> bool:
        """Whether a remaining motion (4,) is short enough to close or open the gripper."""
        distance, angle = self.arrival
        return bool((np.abs(motion) <= [distance, distance, distance, angle]).all())


COARSE = Control(
    actions_per_second=4,
    max_steps=50,
    step=0.05,
    yaw_step=np.pi / 4,
    speed=0.2,
    arrival=(0.05, np.pi / 4),
    ramp_steps=27,
    hold_steps=13,
    finger_steps=25,
)
FINE = Control(
    actions_per_second=10,
    max_steps=200,
    step=0.015,
    yaw_step=np.pi / 12,
    speed=0.08,
    arrival=(0.005, 0.1),
    ramp_steps=14,
    hold_steps=4,
    finger_steps=6,
)
CONTROLS = {"coarse": COARSE, "fine": FINE}
