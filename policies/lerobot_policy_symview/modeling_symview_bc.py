"""The behaviour-cloning policy."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, Literal

import torch
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
        super().__init__(config, dataset_stats)
        self.config: SymviewBcConfig = config
        self.network = Network(config, self.inputs, RegressionHead)
        self.averaged = deepcopy(self.network).requires_grad_(False) if config.weight_averaging else None

    def get_optim_params(self) -> Any:
        """Return every parameter that is trained: one rate for all."""
        return self.network.parameters()

    def update(self) -> None:
        """Let the averaged weights follow; LeRobot calls this after every optimiser step."""
        if self.averaged is not None:
            with torch.no_grad():
                for average, current in zip(self.averaged.parameters(), self.network.parameters(), strict=True):
                    average.lerp_(current, 1 - self.config.weight_averaging)

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

    def best_action(self, picture: Tensor, state: Tensor) -> Tensor:
        """Return the scaled action (B, A) for what the network gets."""
        network = self.network if self.averaged is None else self.averaged
        actions: Tensor = network(picture, state)
        return actions
