"""What makes actions of an encoder's features, and the loss that trains it.

A head gets features (B, G, n) with their group axis. It may mix the axis away, as least squares does, or keep it and
apply a network of its own to every element's features, with shared weights, before it does.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lerobot_policy_symview.symmetry.groups import block_diagonal

LOG_STD_LIMITS = (-20.0, 2.0)  # Haarnoja et al. (2018)


class EquivariantLinear(nn.Module):
    """Linear map from fields to values that move by a representation rho: y = sum over g of rho(g) W f_g + b.

    Args:
        fields: n.
        representation: (G, A, A), rho.
    """

    representation: Tensor
    fixed: Tensor

    def __init__(self, fields: int, representation: NDArray):
        super().__init__()
        group_size, entries = representation.shape[:2]
        matrices = torch.tensor(representation, dtype=torch.get_default_dtype())
        self.register_buffer("representation", matrices, persistent=False)
        # a bias must not move: only entries that no element changes have one
        unmoved = (matrices == torch.eye(entries, dtype=matrices.dtype)).all(dim=0).all(dim=1)
        self.register_buffer("fixed", unmoved.nonzero()[:, 0], persistent=False)
        self.weight = nn.Parameter(torch.empty(entries, fields))
        nn.init.normal_(self.weight, std=1 / math.sqrt(group_size * fields))
        self.bias = nn.Parameter(torch.zeros(len(self.fixed)))

    def forward(self, features: Tensor) -> Tensor:
        """Map features (B, G, n) to (B, A), in the weights' precision even where autocast lowers others'."""
        with torch.autocast(features.device.type, enabled=False):
            values = functional.linear(features.to(self.weight.dtype), self.weight)
            moved = torch.einsum("gab,xgb->xa", self.representation, values)
            return moved.index_add(1, self.fixed, self.bias.expand(len(moved), -1))


class RegressionHead(EquivariantLinear):
    """One action per observation, trained by least squares (paper A.3)."""

    def loss(self, features: Tensor, action: Tensor) -> Tensor:
        """Return squared errors (B, A) of the scaled actions (B, A)."""
        return functional.mse_loss(self(features), action, reduction="none")


class GaussianHead(nn.Module):
    """A normal distribution of scaled actions: a mean that moves, and standard deviations that stay.

    The two entries of a vector share one standard deviation, since a quarter turn exchanges them.

    Args:
        fields: n.
        representation: (G, A, A), rho.
        shared: which standard deviation each of the A entries has, counted from 0.
    """

    shared: Tensor

    def __init__(self, fields: int, representation: NDArray[np.float64], shared: list[int]):
        super().__init__()
        self.actions = representation.shape[-1]
        unmoved = np.ones((len(representation), 1, 1))
        self.linear = EquivariantLinear(fields, block_diagonal([representation] + [unmoved] * len(set(shared))))
        self.register_buffer("shared", torch.tensor(shared), persistent=False)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Map features (B, G, n) to means and logarithms of standard deviations, (B, A) each."""
        values = self.linear(features)
        log_std = values[:, self.actions :].clamp(*LOG_STD_LIMITS)
        return values[:, : self.actions], log_std[:, self.shared]
