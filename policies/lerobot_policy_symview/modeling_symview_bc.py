"""The behaviour-cloning policy."""

from __future__ import annotations

from functools import partial
from typing import Any

from torch import Tensor

from lerobot_policy_symview.chunks import ChunkPolicy
from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.nn.heads import FlowHead, RegressionHead
from lerobot_policy_symview.policy import Network


class SymviewBcPolicy(ChunkPolicy):
    """Predicts the expert's action by least squares, from one observation as in the paper.

    With a longer horizon it predicts chunks, as flow matching does, but without noise.
    """

    config_class = SymviewBcConfig
    config: SymviewBcConfig
    name = "symview_bc"
    has_noise = False

    def __init__(self, config: SymviewBcConfig, dataset_stats: dict[str, dict[str, Any]] | None = None, **kwargs: Any):
        chunks = partial(FlowHead, horizon=config.horizon, width=config.denoiser_width, has_noise=False)
        super().__init__(config, RegressionHead if config.horizon == 1 else chunks, dataset_stats)

    def errors(self, features: Tensor, chunk: Tensor, is_pad: Tensor | None) -> Tensor:
        """Return the mean squared errors (B,)."""
        if self.config.horizon == 1:
            errors: Tensor = self.network.head.loss(features, chunk[:, 0]).mean(dim=1)
            return errors
        chunk_errors: Tensor = self.network.head.loss(features, chunk, is_pad)
        return chunk_errors

    def scaled_chunk(self, network: Network, features: Tensor, noise: Tensor) -> Tensor:
        """Return scaled trajectories (B, H, A)."""
        chunk: Tensor = network.head(features)[:, None] if self.config.horizon == 1 else network.head(features, noise)
        return chunk
