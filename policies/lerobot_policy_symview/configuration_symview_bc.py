"""Configuration of the behaviour-cloning policy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim import LRSchedulerConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig

from lerobot_policy_symview.configuration import SymviewConfig


@PreTrainedConfig.register_subclass("symview_bc")
@dataclass
class SymviewBcConfig(SymviewConfig):
    """Behaviour cloning from views of a freely placed camera. The defaults are the paper's."""

    learning_rate_decay: Literal["none", "cosine"] = "none"
    """`cosine` lowers the rate to zero over the training, `none` keeps it, as in the paper."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_choice("learning_rate_decay", ("none", "cosine"))

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """Return the schedule that `learning_rate_decay` names."""
        if self.learning_rate_decay == "cosine":
            return CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=0)
        return None
