"""Gaussian head of the soft actor-critic policy."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lerobot_policy_symview.nn.heads.linear import EquivariantLinear
from lerobot_policy_symview.symmetry.groups import block_diagonal

LOG_STD_LIMITS = (-20.0, 2.0)  # Haarnoja et al. (2018)


class GaussianHead(nn.Module):
    """Diagonal Gaussian over scaled actions with an equivariant mean and invariant standard deviations.

    The two dimensions of a vector share one standard deviation, since a quarter turn exchanges them.

    Args:
        fields: n, number of regular fields of the features.
        representation: (G, A, A), representation of the actions.
        shared: for each of the A dimensions the index of its standard deviation, from 0.
    """

    shared: Tensor

    def __init__(self, fields: int, representation: NDArray[np.float64], shared: list[int]):
        super().__init__()
        self.dimensions = representation.shape[-1]
        trivial = np.ones((len(representation), 1, 1))
        self.linear = EquivariantLinear(fields, block_diagonal([representation] + [trivial] * len(set(shared))))
        # Otherwise a standard deviation can reach its limit within ten updates. It has no gradient there, and
        # behaviour cloning pushes the mean to where tanh saturates.
        nn.init.zeros_(self.linear.weight)
        self.register_buffer("shared", torch.tensor(shared), persistent=False)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Map features (B, G, n) to means and log standard deviations, (B, A) each."""
        values = self.linear(features)
        log_std = values[:, self.dimensions :].clamp(*LOG_STD_LIMITS)
        return values[:, : self.dimensions], log_std[:, self.shared]
