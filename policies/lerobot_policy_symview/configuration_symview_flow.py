"""Configuration of flow matching over action chunks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lerobot.configs.policies import PreTrainedConfig

from lerobot_policy_symview.configuration_chunks import ChunkConfig


@PreTrainedConfig.register_subclass("symview_flow")
@dataclass
class SymviewFlowConfig(ChunkConfig):
    """Action chunks by flow matching, for demonstrations at 10 to 30 Hz that do a task in several ways."""

    n_obs_steps: int = 2
    """Observations that the network sees: the present one and those before it."""
    horizon: int = 16
    """Actions that are predicted at once, the first of them for the present observation."""
    n_action_steps: int = 8
    """Actions of a prediction that are carried out before the next one."""
    integration_steps: int = 8
    """Steps of the integration from noise to a chunk, 1 to 10 or more: fewer are faster and less exact."""
    noise_scale: float = 0.5
    """Standard deviation of the noise in evaluation, 1 in training: with less, chunks keep to what most demonstrations
    do, and repeat fewer of their pauses and mistakes."""
    learning_rate_decay: Literal["none", "cosine"] = "cosine"
    """`cosine` anneals the learning rate to zero; `none` keeps it constant."""
    weight_averaging: float = 0.99
    """Decay of an exponential moving average of the weights, used in evaluation; 0 for none."""

    def check(self) -> None:
        """Check the fields of all policies, those of chunks, and those of flow matching."""
        super().check()
        if not 1 <= self.integration_steps <= 100:
            raise ValueError(f"--policy.integration_steps must lie between 1 and 100, got {self.integration_steps}")
        if not 0 <= self.noise_scale <= 1:
            raise ValueError(f"--policy.noise_scale must lie between 0 and 1, got {self.noise_scale}")
