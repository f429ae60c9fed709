"""The actor of soft actor-critic from demonstrations; `rl` has the critic's updates and the training loop."""

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
from lerobot_symview import keys
from lerobot_symview.views.tracing import is_exporting

HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


class SymviewSacfdPolicy(SymviewPolicy):
    """Tanh-squashed Gaussian policy: it samples actions tanh(x), x ~ N(mean, std), and evaluates with tanh(mean).

    The whole distribution is equivariant. `lerobot-train` clones demonstrations with the evaluation action;
    `symview-train-rl` also learns from rewards.
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
        """Return the squared error of the scaled evaluation action, a scalar or per sample (B,), and no metrics."""
        observation, state, action = self._training_input(batch)
        mode = self.best_action(self.network, observation, state)
        errors = functional.mse_loss(mode, action, reduction="none").mean(dim=1)
        return (errors if reduction == "none" else errors.mean()), {}

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return actions (B, 1, A): dx, dy, dz in metres, dyaw in radians, aperture, in the declared order."""
        return self.select_action(batch)[:, None]

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the action (B, A) for observations (B, ...).

        Raises:
            DivergenceError: if it is not finite; an exported policy does not check it.
        """
        self.eval()
        with self.precision():
            scaled = self.best_action(self.averaged or self.network, *self.network_input(batch))
        action = self.physical(scaled)
        if not is_exporting():  # an exported program has no branches on values
            self.check_action(action, batch)
        return action

    def best_action(self, network: Network, observation: Tensor, state: Tensor) -> Tensor:
        """Return the scaled evaluation action (B, A): tanh(mean)."""
        mean, _ = network(observation, state)
        return torch.tanh(mean)

    def sample_action(self, observation: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Sample scaled actions with the reparametrisation trick.

        Returns:
            Actions (B, A) in [-1, 1] and their log-probabilities (B,).
        """
        mean, log_std = self.network(observation, state)
        noise = torch.randn_like(mean)
        unsquashed = mean + log_std.exp() * noise
        return torch.tanh(unsquashed), log_prob_of(unsquashed, noise, log_std)

    def _training_input(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return `network_input` and scaled actions (B, A), randomly transformed and cropped in training mode."""
        state, action, transform, crop_offset = batch[keys.STATE], batch[keys.ACTION], None, None
        if self.training:
            transform, crop_offset = self.random_transform(state), torch.rand(len(state), 2, device=state.device)
        if transform is not None:
            action = self.config.actions.transform(action, transform, absolute_yaw=False)
        return *self.network_input(batch, transform, crop_offset), self.scaled(action)


def log_prob_of(unsquashed: Tensor, noise: Tensor, log_std: Tensor) -> Tensor:
    """Return log pi (B,) of actions tanh(x) at x = mean + std noise, all (B, A) (Haarnoja et al., 2018, appendix C).

    The usual log(1 - tanh(x)^2 + 1e-6) is constant where tanh saturates, so that entropy does not pull the mean back.
    This form equals log(1 - tanh(x)^2) for every x.
    """
    normal = -0.5 * noise**2 - log_std - HALF_LOG_TWO_PI
    log_slope = 2 * (math.log(2) - unsquashed - functional.softplus(-2 * unsquashed))
    return (normal - log_slope).sum(dim=1)
