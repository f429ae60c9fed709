"""Regression head of behaviour cloning."""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional

from lerobot_policy_symview.nn.heads.linear import EquivariantLinear


class RegressionHead(EquivariantLinear):
    """Predicts one scaled action per observation, trained with the squared error (paper A.3)."""

    def loss(self, features: Tensor, action: Tensor) -> Tensor:
        """Return the squared errors (B, A) for features (B, G, n) and scaled actions (B, A)."""
        return functional.mse_loss(self(features), action, reduction="none")
