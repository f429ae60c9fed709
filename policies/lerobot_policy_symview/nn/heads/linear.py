"""Equivariant linear map from regular fields to any representation."""

from __future__ import annotations

import math

import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional


class EquivariantLinear(nn.Module):
    """Linear map from regular fields to a representation rho: y = sum over g of rho(g) W f_g + b.

    Args:
        fields: n, number of regular fields.
        representation: (G, A, A), rho.
    """

    representation: Tensor
    invariant: Tensor

    def __init__(self, fields: int, representation: NDArray):
        super().__init__()
        group_size, dimensions = representation.shape[:2]
        matrices = torch.tensor(representation, dtype=torch.get_default_dtype())
        self.register_buffer("representation", matrices, persistent=False)
        # a bias must be invariant, so only the dimensions that rho leaves unchanged have one
        units = torch.eye(dimensions, dtype=matrices.dtype)
        self.register_buffer("invariant", units[(matrices == units).all(dim=0).all(dim=1)], persistent=False)
        self.weight = nn.Parameter(torch.empty(dimensions, fields))
        nn.init.normal_(self.weight, std=1 / math.sqrt(group_size * fields))
        self.bias = nn.Parameter(torch.zeros(len(self.invariant)))

    def forward(self, features: Tensor) -> Tensor:
        """Map features (B, G, n) to (B, A), in the weights' precision even under autocast."""
        with torch.autocast(features.device.type, enabled=False):
            values = functional.linear(features.to(self.weight.dtype), self.weight)
            # not index_add, whose ONNX export overwrites the output instead where every dimension has a bias
            return torch.einsum("gab,xgb->xa", self.representation, values) + self.bias @ self.invariant
