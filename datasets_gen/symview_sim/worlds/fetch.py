"""Gymnasium-Robotics' FetchPush: a puck, or a cube, pushed onto goals on all its sides."""

from __future__ import annotations

import io
from collections.abc import Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.camera import Array
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.geometry.workspace import Workspace
from symview_sim.settings import needs_extra
from symview_sim.worlds.base import MujocoSettings, MujocoWorld, turned

if TYPE_CHECKING:
    from symview_sim.worlds.env import MujocoEnv

TASK = "FetchPush"
UNIT = 0.05  # metres of the gripper for an action of 1
TABLE = 0.4  # metres, its height in the model
LOW, HIGH = 0.42, 0.5  # metres, the gripper's height in the model while it pushes and while it passes over the cube
BEHIND, CONTACT, TOLERANCE = 0.09, 0.05, 0.02  # metres from the cube's centre


@dataclass(unsafe_hash=True)
class FetchSettings(MujocoSettings):
    """FetchPush, its workspace and cameras.

    Raises:
        OptionError: as `MujocoSettings`, or if the task is another one.
    """

    task: str = TASK
    """The task, `FetchPush`."""
    camera: CameraSpec = field(default_factory=lambda: CameraSpec(azimuth_deg=60.0))
    """The first camera: pose, image size and depth sensor."""
    workspace: Workspace = field(default_factory=lambda: Workspace((0.95, 0.0), 0.4, 0.25))
    """The working area on the table; the robot stands at the origin and looks along x."""

    packages = ("gymnasium-robotics", "mujoco")
    steps_per_second = 25
    max_motion = UNIT

    def check(self) -> None:
        """Raise an OptionError unless the settings describe an environment."""
        super().check()
        if self.task != TASK:
            raise OptionError(f"unknown task {self.task!r}, expected {TASK}")

    @classmethod
    def task_names(cls) -> Sequence[str]:
        """Return `FetchPush`."""
        return (TASK,)

    @property
    def instruction(self) -> str:
        """The task in words."""
        return "push the cube onto the goal"

    @property
    def world_from_model(self) -> Array:
        """(4, 4): the model's table is 0.4 m high, and its robot stands at x = 0.405, y = 0.75."""
        return turned(0.0, (-0.405, -0.75, -TABLE))

    def make(self) -> MujocoEnv:
        """Return a new environment.

        Raises:
            ModuleNotFoundError: if Gymnasium-Robotics is not installed; the message names the extra.
        """
        env = super().make()
        _push_env()
        return env

    def make_world(self) -> FetchPush:
        """Return the task."""
        return FetchPush()


def _push_env() -> Any:
    """Return the class of the environment."""
    advice = io.StringIO()  # on environments that are not used here
    with needs_extra("gymnasium_robotics", "fetch", "FetchPush's tasks"), redirect_stderr(advice):
        from gymnasium_robotics.envs.fetch.push import MujocoFetchPushEnv
    return MujocoFetchPushEnv


class FetchPush(MujocoWorld):
    """FetchPush, with an expert of ours: it has none."""

    def __init__(self) -> None:
        self._env = _push_env()()
        self.model, self.data = self._env.model, self._env.data
        is_target = self.model.body_mocapid[self.model.geom_bodyid] >= 0
        self.model.geom_rgba[is_target, 3] = 0.0  # a cross, metres wide, where the gripper is to go
        self._observation = np.zeros(0)
        self._goal = np.zeros(3)

    def reset(self, seed: int) -> None:
        """Start an episode."""
        reset, _ = self._env.reset(seed=seed)
        self._observation, self._goal = reset["observation"], reset["desired_goal"]
        self._env._render_callback()  # moves the goal's marker

    def gripper(self) -> tuple[Array, float]:
        """Return the point between the fingertips (3,); the fingers stay closed."""
        return self._observation[:3], 0.0

    def step(self, motion: Array, aperture: float) -> bool:
        """Move the gripper by `motion` (3,)."""
        observed, *_, info = self._env.step(np.append(motion / UNIT, 0.0))
        self._observation = observed["observation"]
        return bool(info["is_success"])

    def expert_action(self) -> tuple[Array, float]:
        """Return the motion (3,) behind the cube, down, and toward the goal; and the aperture."""
        gripper, cube = self._observation[:3], self._observation[3:6]
        toward = (self._goal - cube)[:2]
        heading = toward / max(float(np.linalg.norm(toward)), 1e-6)
        offset = (gripper - cube)[:2]
        along = offset @ heading
        aside = offset - along * heading
        behind = cube[:2] - BEHIND * heading
        if along < -CONTACT / 2 and np.linalg.norm(aside) < TOLERANCE and gripper[2] < LOW + TOLERANCE:
            target = np.append(self._goal[:2] - CONTACT * heading - aside, LOW)
        elif np.linalg.norm(gripper[:2] - behind) < TOLERANCE:
            target = np.append(behind, LOW)
        elif gripper[2] > HIGH - TOLERANCE:
            target = np.append(behind, HIGH)
        else:
            target = np.append(gripper[:2], HIGH + TOLERANCE)
        motion = target - gripper
        return motion * min(1.0, UNIT / max(float(np.abs(motion).max()), 1e-9)), 0.0
