"""Configuration of soft actor-critic from demonstrations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from lerobot.configs.policies import PreTrainedConfig

from lerobot_policy_symview.configuration import SymviewConfig


@PreTrainedConfig.register_subclass("symview_sacfd")
@dataclass
class SymviewSacfdConfig(SymviewConfig):
    """Soft actor-critic from demonstrations (SACfD) on top-down views. The defaults are the paper's."""

    augmentation: Literal["none", "d4", "so2", "o2", "group"] = "so2"
    """Random planar transform of every sampled transition. `so2`: a rotation by any angle, as in the paper, which
    stores rotated copies instead. `d4`: a quarter turn, reflected or not. `o2`: a rotation by any angle, reflected or
    not. `group`: an element of `--policy.group`. `none`: no augmentation.
    """
    discount: float = 0.99
    """Discount factor per action."""
    bc_weight: float = 1.0
    """Weight of the behaviour-cloning loss in the actor's loss: the squared error between the policy's actions and the
    demonstrated ones, on demonstrated transitions only.
    """
    initial_temperature: float = 0.01
    """Initial weight of the entropy bonus (alpha in SAC); it is tuned during training."""
    target_entropy: float | None = None
    """Entropy that the temperature is tuned to; None for minus the number of action dimensions, -5."""
    target_update: Literal["polyak", "hard"] = "polyak"
    """Update rule of the target critic. `polyak`: exponential moving average with `target_tau` at every update. `hard`:
    a copy of the critic every `target_interval` updates.
    """
    target_tau: float = 0.01
    """Polyak coefficient tau: target = (1 - tau) target + tau critic."""
    target_interval: int = 100
    """Updates between copies of the critic, with `--policy.target_update=hard`."""
    grad_clip_norm: float | None = None
    """Largest norm of the actor's and of the critic's gradient; None for no limit, as in the paper. Single
    gradients of the actor can be twenty to sixty times as large as others.
    """
    timeouts_are_terminal: bool = False
    """Do not bootstrap from the last observation of an episode that ran out of time. By default the TD target
    bootstraps there, since a time limit says nothing about the value of a state; the code the paper builds on does not.
    """

    def check(self) -> None:
        """Check the fields of all policies and those of soft actor-critic."""
        super().check()
        if self.n_obs_steps != 1:
            raise ValueError(f"--policy.n_obs_steps must be 1 for symview_sacfd, got {self.n_obs_steps}")
        if self.camera_augmentation:
            raise ValueError(
                "--policy.camera_augmentation is for cloned policies: simulators give views in place of images"
            )
        if self.check_camera:
            raise ValueError("--policy.check_camera is for cloned policies: simulators give views in place of images")
        self._check_choice("target_update", ("polyak", "hard"))
        for name in ("discount", "target_tau"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"--policy.{name} must be above 0 and at most 1, got {getattr(self, name)}")
        if not 0 < self.initial_temperature < math.inf:
            raise ValueError(f"--policy.initial_temperature must be positive, got {self.initial_temperature}")
        if not 0 <= self.bc_weight < math.inf:
            raise ValueError(f"--policy.bc_weight must not be negative, got {self.bc_weight}")
        if self.target_entropy is not None and not math.isfinite(self.target_entropy):
            raise ValueError(f"--policy.target_entropy must be finite, got {self.target_entropy}")
        if self.grad_clip_norm is not None and not 0 < self.grad_clip_norm < math.inf:
            raise ValueError(f"--policy.grad_clip_norm must be positive and finite, got {self.grad_clip_norm}")
        if self.target_interval < 1:
            raise ValueError(f"--policy.target_interval must be at least 1, got {self.target_interval}")

    @property
    def entropy_target(self) -> float:
        """Entropy that the temperature is tuned to."""
        return -float(len(self.action_symmetry)) if self.target_entropy is None else self.target_entropy
