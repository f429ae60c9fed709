"""The behaviour-cloning policy."""

from __future__ import annotations

from typing import Any, Literal

from torch import Tensor

from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.heads import RegressionHead
from lerobot_policy_symview.layers import asymmetry
from lerobot_policy_symview.policy import Network, SymviewPolicy


class SymviewBcPolicy(SymviewPolicy):
    """Predicts the expert's action from one observation by least squares."""

    config_class = SymviewBcConfig
    name = "symview_bc"

    def __init__(self, config: SymviewBcConfig, dataset_stats: dict[str, dict[str, Any]] | None = None, **kwargs: Any):
        super().__init__(config, RegressionHead, dataset_stats)

    def forward(
        self, batch: dict[str, Tensor], reduction: Literal["mean", "none"] = "mean"
    ) -> tuple[Tensor, dict[str, Any]]:
        """Return the squared error of the scaled action, mean or (B,), and what else the log should show.

        That is nothing but for relaxed networks: reading a number from a GPU would make every step wait for it.
        """
        picture, state, action = self.training_input(batch)
        errors = self.network.head.loss(self.network.encoder(picture, state), action).mean(dim=1)
        output = {}
        if self.config.encoder == "relaxed":
            penalty = asymmetry(self.network)
            output["asymmetry"] = penalty.item()
            errors = errors + self.config.relaxation_weight * penalty
        return (errors if reduction == "none" else errors.mean()), output

    def best_action(self, network: Network, picture: Tensor, state: Tensor) -> Tensor:
        """Return the scaled action (B, A)."""
        actions: Tensor = network(picture, state)
        return actions
