"""The behaviour-cloning policy."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from lerobot_policy_symview.chunks import ChunkPolicy
from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.nn.heads import FlowHead, RegressionHead
from lerobot_policy_symview.nn.layers import asymmetry
from lerobot_policy_symview.policy import Network
from lerobot_symview import keys


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

    def forward(
        self, batch: dict[str, Tensor], reduction: Literal["mean", "none"] = "mean"
    ) -> tuple[Tensor, dict[str, Any]]:
        """Return the squared error of the scaled actions, mean or (B,), and metrics for the log.

        Only relaxed networks have a metric: reading a number from a GPU makes every step wait for it.
        """
        if self.training and self.config.aperture_noise:
            batch = batch | {keys.STATE: self._noisy(batch[keys.STATE])}
        errors, output = super().forward(batch, "none")
        if self.config.encoder == "relaxed":
            penalty = asymmetry(self.network)
            output["asymmetry"] = penalty.item()
            errors = errors + self.config.relaxation_weight * penalty
        return (errors if reduction == "none" else errors.mean()), output

    def _noisy(self, state: Tensor) -> Tensor:
        """Return states (..., S) with noise on the apertures."""
        apertures = self.config.states.of_type("aperture")
        noisy = state.clone()
        noisy[..., apertures] += self.config.aperture_noise * torch.randn_like(noisy[..., apertures])
        return noisy

    def errors(self, features: Tensor, chunk: Tensor, is_pad: Tensor | None) -> Tensor:
        """Return the mean squared errors (B,)."""
        if self.config.horizon == 1:
            errors: Tensor = self.network.head.loss(features, chunk[:, 0]).mean(dim=1)
            return errors
        return self.network.head.loss(features, chunk, is_pad)

    def scaled_chunk(self, network: Network, features: Tensor, noise: Tensor) -> Tensor:
        """Return scaled trajectories (B, H, A)."""
        chunk: Tensor = network.head(features)[:, None] if self.config.horizon == 1 else network.head(features, noise)
        return chunk
