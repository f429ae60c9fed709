"""Meta-World: tasks of a Sawyer arm, with the scripted experts that come with them."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_symview.geometry.camera import Array
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.registry import check_name
from symview_sim.settings import needs_extra
from symview_sim.worlds.base import MujocoSettings, MujocoWorld, check_mujoco_import, turned

if TYPE_CHECKING:
    from symview_sim.worlds.env import MujocoEnv

UNIT = 0.01  # metres of the hand for an action of 1, in a step


@dataclass(unsafe_hash=True)
class MetaWorldSettings(MujocoSettings):
    """A task of Meta-World, its workspace and cameras.

    Raises:
        OptionError: as `MujocoSettings`.
    """

    task: str = "push-v3"
    """The task, such as `push-v3`, `pick-place-v3`, `drawer-open-v3`."""
    camera: CameraSpec = field(default_factory=lambda: CameraSpec(azimuth_deg=60.0, distance=1.0))
    """The first camera: pose, image size and depth sensor."""
    workspace: Workspace = field(default_factory=lambda: Workspace((0.7, 0.0), 0.5, 0.3))
    """The working area on the table; the robot stands at the origin and looks along x."""
    max_steps: int = 40
    """Actions per episode."""
    action_repeat: int = 5
    """Steps of the simulator per action, in equal parts; 5 gives 16 actions a second."""

    packages = ("metaworld", "mujoco")
    steps_per_second = 80
    max_motion = UNIT

    @classmethod
    def task_names(cls) -> Sequence[str]:
        """Return the names of Meta-World's tasks."""
        return list(_tasks())

    @property
    def instruction(self) -> str:
        """The task in words."""
        return self.task.rpartition("-v")[0].replace("-", " ")

    @property
    def world_from_model(self) -> Array:
        """(4, 4): Meta-World's robot looks along y."""
        return turned(-90.0, (0.0, 0.0, 0.0))

    def make(self) -> MujocoEnv:
        """Return a new environment.

        Raises:
            ModuleNotFoundError: if Meta-World is not installed; the message names the extra.
            ValueError: if Meta-World has no such task.
        """
        env = super().make()
        check_task(self.task)
        return env

    def make_world(self) -> MetaWorld:
        """Return the task."""
        return MetaWorld(self.task)


def check_task(name: str) -> None:
    """Raise a ValueError that lists all tasks unless `name` is one of them."""
    check_mujoco_import()
    check_name("task of Meta-World", name, _tasks())


def _tasks() -> dict[str, Any]:
    """Return the classes of Meta-World's tasks by name."""
    with needs_extra("metaworld", "metaworld", "the tasks of Meta-World"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Gymnasium's, of Meta-World's spaces
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS
    return dict(ALL_V3_ENVIRONMENTS)


class MetaWorld(MujocoWorld):
    """A task of Meta-World.

    Args:
        task: its name, such as `push-v3`.
    """

    def __init__(self, task: str):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Gymnasium's, of Meta-World's spaces
            self._env: Any = _tasks()[task]()
        from metaworld.policies import ENV_POLICY_MAP

        self._expert: Any = ENV_POLICY_MAP[task]()
        # What its benchmarks do by a pickled task: a new scene in every episode, which follows from the seed, and a
        # goal that the expert can read.
        self._env._set_task_called = self._env.seeded_rand_vec = True
        self._env._freeze_rand_vec = self._env._partially_observable = False
        vars(self._env).pop("sawyer_observation_space", None)  # the cached one clips the goal to 0
        self._env.max_path_length = sys.maxsize
        self.model, self.data = self._env.model, self._env.data
        self._observation = np.zeros(0)

    def reset(self, seed: int) -> None:
        """Start an episode."""
        import mujoco

        self._env.seed(seed)
        self._observation, _ = self._env.reset()
        for site in self._env._target_site_config:  # else the goal's marker stays where it was until the first step
            self._env._set_pos_site(*site)
        mujoco.mj_forward(self.model, self.data)

    def gripper(self) -> tuple[Array, float]:
        """Return the point between the fingertips (3,), and the aperture in [0, 1]."""
        return self._env.tcp_center, float(self._observation[3])

    def step(self, motion: Array, aperture: float) -> bool:
        """Move the hand's target by `motion` (3,); the last number is the fingers' effort, 1 to close."""
        action = np.append(motion / UNIT, 1 - 2 * aperture)
        self._observation, *_, info = self._env.step(action)
        return bool(info["success"])

    def expert_action(self) -> tuple[Array, float]:
        """Return the expert's motion (3,) in one step, and its aperture."""
        action = np.clip(np.asarray(self._expert.get_action(self._observation), dtype=np.float64), -1, 1)
        return action[:3] * UNIT, float(1 - action[3]) / 2
