"""What a task is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from lerobot_symview.geometry.camera import Array
from symview_sim.scene import Scene


class Task(ABC):
    """One manipulation task: what lies on the table, when it is solved, and how an expert solves it.

    The module that defines it is named after the task and exports the class as `TASK`.
    """

    instruction: ClassVar[str]

    @abstractmethod
    def spawn(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the task's objects at random, all randomness from `rng`."""

    @abstractmethod
    def is_success(self, scene: Scene) -> bool:
        """Whether the task is solved."""

    @abstractmethod
    def is_valid(self, scene: Scene) -> bool:
        """Whether the task can still be solved; an episode ends when not."""

    @abstractmethod
    def expert_action(self, scene: Scene) -> Array:
        """Return the expert's action (5,) in the present state: dx, dy, dz (m), dyaw (rad), aperture."""
