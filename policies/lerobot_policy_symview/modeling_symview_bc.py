"""The behaviour-cloning policy."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.nn.heads import RegressionHead
from lerobot_policy_symview.nn.layers import asymmetry
from lerobot_policy_symview.policy import Network, SymviewPolicy
from lerobot_symview import keys


class SymviewBcPolicy(SymviewPolicy):
    """Predicts the expert's action from one observation by least squares."""

    config_class = SymviewBcConfig
    config: SymviewBcConfig
    name = "symview_bc"

    def __init__(self, config: SymviewBcConfig, dataset_stats: dict[str, dict[str, Any]] | None = None, **kwargs: Any):
        super().__init__(config, RegressionHead, dataset_stats)

    def forward(
        self, batch: dict[str, Tensor], reduction: Literal["mean", "none"] = "mean"
    ) -> tuple[Tensor, dict[str, Any]]:
        """Return the squared error of the scaled action, mean or (B,), and metrics for the log.

        Only relaxed networks have a metric: reading a number from a GPU makes every step wait for it.
        """
        if self.training and self.config.aperture_noise:
            batch = batch | {keys.STATE: self._noisy(batch[keys.STATE])}
        observation, state, action = self.training_input(batch)
        errors = self.network.head.loss(self.network.encoder(observation, state), action).mean(dim=1)
        output = {}
        if self.config.encoder == "relaxed":
            penalty = asymmetry(self.network)
            output["asymmetry"] = penalty.item()
            errors = errors + self.config.relaxation_weight * penalty
        return (errors if reduction == "none" else errors.mean()), output

    def _noisy(self, state: Tensor) -> Tensor:
        """Return states (B, S) with noise on the apertures."""
        apertures = self.config.states.of_type("aperture")
        noisy = state.clone()
        noisy[:, apertures] += self.config.aperture_noise * torch.randn_like(noisy[:, apertures])
        return noisy

    def best_action(self, network: Network, observation: Tensor, state: Tensor) -> Tensor:
        """Return the scaled action (B, A)."""
        actions: Tensor = network(observation, state)
        return actions
