"""The interface of a task."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from lerobot_symview.geometry.camera import Array
from symview_sim.scene import Scene


class Task(ABC):
    """One manipulation task: its objects, its success condition and its scripted expert.

    The module of a built-in task has the task's name and exports the class as `TASK`.
    """

    instruction: ClassVar[str]
    """The task in words, which datasets store and language-conditioned policies read."""
    ways: ClassVar[int] = 1
    """Number of ways to solve the task from which a person may choose, such as the two pairs of faces of a cube. A
    reflection of the scene may exchange ways, as left and right."""
    mistakes: ClassVar[tuple[str, ...]] = ("wrong_place",)
    """Mistakes that a person may make (`human_style.Style.mistake`)."""

    @abstractmethod
    def spawn(self, scene: Scene, rng: np.random.Generator) -> None:
        """Add the task's objects at random poses. All randomness comes from `rng`."""

    @abstractmethod
    def is_success(self, scene: Scene) -> bool:
        """Whether the task is solved."""

    @abstractmethod
    def is_valid(self, scene: Scene) -> bool:
        """Whether the task can still be solved. If not, the episode ends."""

    @abstractmethod
    def expert_action(self, scene: Scene) -> Array:
        """Return the expert's action (5,) in the current state: dx, dy, dz (m), dyaw (rad), aperture in [0, 1].

        The motion may be longer than an action; the environment shortens it to the speed of `scene.control`.
        """

    def action_of_way(self, scene: Scene, way: int) -> Array:
        """Return what a person does in the current state to solve the task in one of its `ways`, 0 to `ways` - 1.

        As `expert_action`, but the choice is the way's: the state alone does not determine the action.
        """
        return self.expert_action(scene)
