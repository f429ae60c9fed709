"""Configuration of soft actor-critic from demonstrations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lerobot.configs.policies import PreTrainedConfig

from lerobot_policy_symview.configuration import SymviewConfig


@PreTrainedConfig.register_subclass("symview_sacfd")
@dataclass
class SymviewSacfdConfig(SymviewConfig):
    """Soft actor-critic from demonstrations (SACfD), on views. The defaults are the paper's."""

    augmentation: Literal["none", "d4", "so2", "o2", "group"] = "so2"
    """Move each sampled transition by a random element: any turn, as the paper does when it stores one, quarter turns
    and mirror images, or any turn and mirror images.
    """
    discount: float = 0.99
    """Of rewards, per action."""
    expert_weight: float = 1.0
    """Weight of the squared difference between the policy's actions and the expert's where the expert acted."""
    initial_temperature: float = 0.01
    """Weight of the entropy at the start; it is then tuned."""
    target_entropy: float | None = None
    """Entropy that the temperature is tuned to; by default minus the number of an action's entries, -5."""
    target_update: Literal["polyak", "hard"] = "polyak"
    """How the target critic follows: `polyak` moves it by `target_rate` at every update, `hard` copies the critic every
    `target_interval` updates.
    """
    target_rate: float = 0.01
    """Part of the difference to the critic, `polyak`."""
    target_interval: int = 100
    """Updates between copies, `hard`."""
    timeouts_are_terminal: bool = False
    """Give the last state of an episode that ran out of time no value. An episode's end by the clock says nothing about
    what the state was worth, so by default its value is what the critic says; the paper's code cuts it off.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_choice("target_update", ("polyak", "hard"))
        for name in ("discount", "target_rate"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"--policy.{name} must be above 0 and at most 1, got {getattr(self, name)}")
        if self.initial_temperature <= 0:
            raise ValueError(f"--policy.initial_temperature must be positive, got {self.initial_temperature}")
        if self.expert_weight < 0:
            raise ValueError(f"--policy.expert_weight must not be negative, got {self.expert_weight}")
        if self.target_interval < 1:
            raise ValueError(f"--policy.target_interval must be at least 1, got {self.target_interval}")

    @property
    def entropy(self) -> float:
        """The entropy that the temperature is tuned to."""
        return -float(len(self.action_symmetry)) if self.target_entropy is None else self.target_entropy
