"""Configuration of the behaviour-cloning policy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim import LRSchedulerConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig

from lerobot_policy_symview.configuration import SymviewConfig


@PreTrainedConfig.register_subclass("symview_bc")
@dataclass
class SymviewBcConfig(SymviewConfig):
    """Behaviour cloning on top-down views from freely placed cameras. The defaults are the paper's."""

    learning_rate_decay: Literal["none", "cosine"] = "none"
    """`cosine` anneals the learning rate to zero; `none` keeps it constant, as in the paper."""
    aperture_noise: float = 0.0
    """Standard deviation of Gaussian noise on the state's `aperture` dimensions in training, in their unit. An expert
    opens the gripper to exactly the same aperture every time, a policy does not: without noise, the policy's own
    apertures are out of distribution."""

    def check(self) -> None:
        """Check the fields of all policies and those of behaviour cloning."""
        super().check()
        self._check_choice("learning_rate_decay", ("none", "cosine"))
        if not 0 <= self.aperture_noise < math.inf:
            raise ValueError(f"--policy.aperture_noise must be finite and at least 0, got {self.aperture_noise}")
        if self.aperture_noise and not self.states.of_type("aperture"):
            raise ValueError(
                f"--policy.aperture_noise={self.aperture_noise} needs a dimension `aperture` in "
                f"--policy.state_symmetry, got {self.state_symmetry}"
            )

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """Return the schedule that `learning_rate_decay` names."""
        if self.learning_rate_decay == "cosine":
            return CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=0)
        return None
