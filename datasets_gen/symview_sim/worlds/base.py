"""What a simulator on MuJoCo must offer to be recorded, trained on and evaluated, and the settings of its environment.

A new one is a class derived from `MujocoWorld` and one derived from `MujocoSettings` (docs/own_simulator.md).
"""

from __future__ import annotations

import math
import os
from abc import ABC, abstractmethod
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.camera import Array
from lerobot_symview.runtime.cli import CommandError
from symview_sim.settings import WorldSettings

if TYPE_CHECKING:
    from symview_sim.worlds.env import MujocoEnv


REMEDY = (
    "install Mesa's software renderer, on Debian and Ubuntu apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri, or "
    "libosmesa6 and set MUJOCO_GL=osmesa"
)


def check_mujoco_import() -> None:
    """Raise a CommandError if MuJoCo is installed and its import fails, as with a `MUJOCO_GL` that is not there."""
    if find_spec("mujoco") is None:
        return  # the error of the package that needs it names the extra
    try:
        import mujoco  # noqa: F401
    except Exception as error:  # of the library that MUJOCO_GL names
        chosen = os.environ.get("MUJOCO_GL", "")
        raise CommandError(f"MuJoCo cannot draw with MUJOCO_GL={chosen}: {error}; unset it, or {REMEDY}") from None


class MujocoWorld(ABC):
    """One task of a simulator on MuJoCo, whose gripper never turns, and its scripted expert.

    Positions and motions are in the frame of the MuJoCo model, metres.
    """

    model: Any
    """`mujoco.MjModel`."""
    data: Any
    """`mujoco.MjData`."""

    @abstractmethod
    def reset(self, seed: int) -> None:
        """Start an episode. All its randomness follows from `seed`. What is drawn, such as a goal, is up to date."""

    @abstractmethod
    def gripper(self) -> tuple[Array, float]:
        """Return the point between the fingertips (3,), and the aperture in [0, 1]."""

    @abstractmethod
    def step(self, motion: Array, aperture: float) -> bool:
        """Move the gripper by `motion` (3,), as far as it gets in one step, and return whether the task is solved."""

    @abstractmethod
    def expert_action(self) -> tuple[Array, float]:
        """Return the expert's motion (3,) in one step, and its aperture."""


@dataclass(unsafe_hash=True)
class MujocoSettings(WorldSettings):
    """A task of a simulator on MuJoCo.

    Raises:
        OptionError: as `WorldSettings`, or if a number of actions is out of range, or a camera is to see no robot.
    """

    max_steps: int = 50
    """Actions per episode."""
    action_repeat: int = 1
    """Steps of the simulator per action, in equal parts."""

    state_names = ("x", "y", "z", "aperture")
    action_names = ("dx", "dy", "dz", "aperture")
    steps_per_second: ClassVar[int]
    """Steps of the simulator per second."""
    max_motion: ClassVar[float]
    """Largest motion along an axis in a step, metres."""

    def check(self) -> None:
        """Raise an OptionError unless the settings describe an environment."""
        super().check()
        if self.action_repeat < 1:
            raise OptionError(f"action_repeat must be at least 1, got {self.action_repeat}")
        blind = [spec.name for spec in self.all_cameras if not spec.sees_robot]
        if blind:
            raise OptionError(f"camera {blind[0]!r} has sees_robot=false, which only PyBullet's tasks offer")

    @property
    def actions_per_second(self) -> int:
        """Actions per second."""
        return max(round(self.steps_per_second / self.action_repeat), 1)

    @property
    def episode_steps(self) -> int:
        """Largest number of actions of an episode."""
        return self.max_steps

    @property
    @abstractmethod
    def instruction(self) -> str:
        """The task in words."""

    @property
    @abstractmethod
    def world_from_model(self) -> Array:
        """(4, 4) transform from the model's frame to ours: the table at z = 0, the robot looking along x."""

    @abstractmethod
    def make_world(self) -> MujocoWorld:
        """Return the task. The simulator is imported only now."""

    def make(self) -> MujocoEnv:
        """Return a new environment.

        Raises:
            CommandError: if MuJoCo cannot be imported with the present `MUJOCO_GL`.
        """
        from symview_sim.worlds.env import MujocoEnv

        check_mujoco_import()
        return MujocoEnv(self)


def turned(yaw_deg: float, translation: tuple[float, float, float]) -> Array:
    """Return the transform (4, 4) that turns about the vertical, then translates, metres."""
    cos, sin = round(math.cos(math.radians(yaw_deg)), 12), round(math.sin(math.radians(yaw_deg)), 12)
    matrix = np.eye(4)
    matrix[:2, :2] = [[cos, -sin], [sin, cos]]
    matrix[:3, 3] = translation
    return matrix
