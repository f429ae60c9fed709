"""The policy that samples action chunks by flow matching."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor

from lerobot_policy_symview.chunks import ChunkPolicy
from lerobot_policy_symview.configuration_symview_flow import SymviewFlowConfig
from lerobot_policy_symview.nn.heads import FlowHead
from lerobot_policy_symview.policy import Network


class SymviewFlowPolicy(ChunkPolicy):
    """Samples action chunks: where demonstrations do a task in several ways, it chooses one, and does not average them.

    The distribution of its chunks is equivariant: for a transformed scene and transformed noise, the chunk is the
    transformed one.
    """

    config_class = SymviewFlowConfig
    config: SymviewFlowConfig
    name = "symview_flow"
    has_noise = True

    def __init__(
        self, config: SymviewFlowConfig, dataset_stats: dict[str, dict[str, Any]] | None = None, **kwargs: Any
    ):
        super().__init__(config, partial(FlowHead, horizon=config.horizon, width=config.denoiser_width), dataset_stats)

    def errors(self, features: Tensor, chunk: Tensor, is_pad: Tensor | None) -> Tensor:
        """Return the mean squared errors (B,) of predicted chunks."""
        errors: Tensor = self.network.head.loss(features, chunk, is_pad)
        return errors

    def draw_noise(self, samples: int, generator: torch.Generator | None = None) -> Tensor:
        """Return noise (B, H, A) for chunks, of the standard deviation `noise_scale`."""
        return self.config.noise_scale * super().draw_noise(samples, generator)

    def scaled_chunk(self, network: Network, features: Tensor, noise: Tensor) -> Tensor:
        """Return scaled trajectories (B, H, A) that start as noise."""
        chunk: Tensor = network.head(features, noise, self.config.integration_steps)
        return chunk
