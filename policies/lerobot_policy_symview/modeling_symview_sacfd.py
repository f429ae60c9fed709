"""The actor of soft actor-critic from demonstrations; what its training needs besides is in `rl`."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn import functional

from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.nn.heads import GaussianHead
from lerobot_policy_symview.policy import Network, SymviewPolicy

HALF_LOG_TAU = 0.5 * math.log(2 * math.pi)
SMALLEST_SLOPE = 1e-6  # of tanh, where an action is at the end of its range


class SymviewSacfdPolicy(SymviewPolicy):
    """Draws scaled actions tanh(x) of normally distributed x; evaluated, it takes tanh of the mean.

    The distribution moves with the scene. `lerobot-train` fits its evaluated action to demonstrations;
    `symview-train-rl` learns from reward as well.
    """

    config_class = SymviewSacfdConfig
    name = "symview_sacfd"

    def __init__(
        self, config: SymviewSacfdConfig, dataset_stats: dict[str, dict[str, Any]] | None = None, **kwargs: Any
    ):
        super().__init__(config, partial(GaussianHead, shared=config.actions.shared_scales), dataset_stats)
        self.config: SymviewSacfdConfig = config

    def forward(
        self, batch: dict[str, Tensor], reduction: Literal["mean", "none"] = "mean"
    ) -> tuple[Tensor, dict[str, Any]]:
        """Return the squared error of the evaluated action, scaled, mean or (B,), and nothing to log."""
        picture, state, action = self.training_input(batch)
        best = self.best_action(self.network, picture, state)
        errors = functional.mse_loss(best, action, reduction="none").mean(dim=1)
        return (errors if reduction == "none" else errors.mean()), {}

    def best_action(self, network: Network, picture: Tensor, state: Tensor) -> Tensor:
        """Return the scaled action (B, A): tanh of the mean."""
        mean, _ = network(picture, state)
        return torch.tanh(mean)

    def draw(self, picture: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return scaled actions (B, A) at random, differentiably, and the logarithms (B,) of their densities."""
        mean, log_std = self.network(picture, state)
        noise = torch.randn_like(mean)
        action = torch.tanh(mean + log_std.exp() * noise)
        return action, log_density(action, noise, log_std)


def log_density(action: Tensor, noise: Tensor, log_std: Tensor) -> Tensor:
    """Return log p (B,) of actions tanh(mean + std noise), all (B, A) (Haarnoja et al., 2018, appendix C)."""
    normal = -0.5 * noise**2 - log_std - HALF_LOG_TAU
    return (normal - torch.log(1 - action**2 + SMALLEST_SLOPE)).sum(dim=1)
