"""Group-equivariant layers: filters are expanded from free weights and passed to ordinary convolutions.

Features are n regular fields: one number per field and group element, stored as G blocks of n channels with the group
axis outermost. When the scene is transformed by g, block h becomes block g^-1 h. Filters satisfy the kernel constraint
of Cohen et al. (2019) by construction: the filter of output block g is the identity's filter, transformed by g.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lerobot_policy_symview.symmetry.groups import DECIMALS, PlanarGroup
from lerobot_symview.views.tracing import is_exporting

RING_WIDTH = 0.4  # pixels; as in escnn's 3 x 3 filters, so that both span the same functions
FREQUENCIES = 2  # highest angular frequency of the ring; 3 x 3 pixels hold no more without aliasing
TAPS = 9  # pixels of a 3 x 3 filter


def steerable_basis(group: PlanarGroup) -> NDArray[np.float64]:
    """Return the orthonormal basis of steerable 3 x 3 filters, transformed by every group element: (G, 6, 9).

    The six functions are the centre pixel and a ring of radius 1 times cos and sin of 0, 1 and 2 times the angle. For
    element g, function b is b(g^-1 x); pixel x is (row, column), along the table's (x, y).
    """
    taps = _transformed_taps(group)
    radius, angle = np.hypot(taps[..., 0], taps[..., 1]), np.arctan2(taps[..., 1], taps[..., 0])
    ring = np.where(radius > 0.5, np.exp(-0.5 * ((radius - 1) / RING_WIDTH) ** 2), 0.0)
    waves = [np.cos(k * angle) for k in range(FREQUENCIES + 1)]
    waves += [np.sin(k * angle) for k in range(1, FREQUENCIES + 1)]
    functions = np.stack([(radius < 0.5).astype(float), *(ring * wave for wave in waves)], axis=1)
    norms = np.linalg.norm(functions[0], axis=-1)  # the identity's for all elements: off the grid, norms would differ
    return (functions / norms[:, None]).round(DECIMALS) + 0.0


def pixel_basis(group: PlanarGroup) -> NDArray[np.float64]:
    """Return the basis of single pixels, transformed by every group element: (G, 9, 9). Filters are unconstrained.

    Raises:
        ValueError: if a group element does not map pixels to pixels.
    """
    if not group.is_exact:
        raise ValueError(
            f"filters of single pixels cannot be rotated by {360 / group.rotations:g} degrees: "
            "use a group of quarter turns"
        )
    row, column = np.moveaxis(_transformed_taps(group).round().astype(int) + 1, -1, 0)
    return np.eye(TAPS)[:, 3 * row + column].transpose(1, 0, 2)


def _transformed_taps(group: PlanarGroup) -> NDArray[np.float64]:
    """Return g^-1 x for every group element g and filter pixel x: (G, 9, 2)."""
    taps = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), axis=-1).reshape(TAPS, 2)
    return np.einsum("gij,ti->gtj", group.rotation(), taps)  # the inverse of an orthogonal matrix is its transpose


class FieldLayer(nn.Module):
    """Base of the equivariant layers: it expands free weights per pair of fields into one filter per output block.

    Args:
        group: G elements.
        inputs: number of regular input fields, or the representation (G, d, d) of d input channels.
        fields: n, number of regular output fields.
        basis: (G, functions, taps), basis of the filters, transformed by every group element.
        depth: size of the filters along the vertical axis, on which the group acts trivially.
    """

    basis: Tensor
    arrangement: Tensor

    def __init__(
        self,
        group: PlanarGroup,
        inputs: int | NDArray[np.float64],
        fields: int,
        basis: NDArray[np.float64],
        depth: int = 1,
    ):
        super().__init__()
        self.group, self.fields, self.depth = group, fields, depth
        self.has_field_inputs = isinstance(inputs, int)
        dtype = torch.get_default_dtype()
        self.register_buffer("basis", torch.tensor(basis, dtype=dtype), persistent=False)
        channels = inputs * group.size if isinstance(inputs, int) else inputs.shape[-1]
        arrangement = torch.tensor(group.quotient if isinstance(inputs, int) else inputs.round(DECIMALS))
        self.register_buffer(
            "arrangement", arrangement if self.has_field_inputs else arrangement.to(dtype), persistent=False
        )
        fan_in = channels * depth * basis.shape[1]
        self.weight = nn.Parameter(torch.empty(fields, channels, depth * basis.shape[1]))
        nn.init.normal_(self.weight, std=math.sqrt(2 / fan_in))  # He et al. (2015); the basis is orthonormal
        self.bias = nn.Parameter(torch.zeros(fields))
        self._cache: tuple[Any, tuple[Tensor, ...]] | None = None

    def train(self, mode: bool = True) -> Self:
        """Switch between training and evaluation mode, and clear the cache."""
        if mode != self.training:
            self._cache = None
        return super().train(mode)

    def expanded(self) -> tuple[Tensor, ...]:
        """Return ordinary filters (G fields, channels, depth, taps) and biases (G fields,)."""
        return self.cached(self._expand)

    def cached(self, compute: Callable[[], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """Return `compute()`, a function of the weights; without gradients the result is cached until they change.

        PyTorch counts no version for changes through `parameter.data`: they take effect after the next switch between
        `train()` and `eval()`. An export records `compute()` and caches nothing.
        """
        if is_exporting():
            return compute()
        if torch.is_grad_enabled():
            self._cache = None
            return compute()
        versions = [(parameter._version, parameter.data_ptr()) for parameter in self.parameters()]
        state = (compute.__name__, versions, autocast_dtype(self.weight))
        if self._cache is None or self._cache[0] != state:
            self._cache = (state, compute())
        return self._cache[1]

    def _expand(self) -> tuple[Tensor, Tensor]:
        dtype = autocast_dtype(self.weight)
        size, functions, taps = self.basis.shape
        weight = self.weight.to(dtype).view(self.fields, -1, self.depth, functions)
        if self.has_field_inputs:
            blocks = weight.view(self.fields, size, -1, self.depth, functions)
            # not blocks[:, self.arrangement], whose backward pass adds gradients in an unspecified order
            chosen = blocks.index_select(1, self.arrangement.flatten()).view(self.fields, size, *blocks.shape[1:])
            # (fields, G out, G in, inputs, ...) to (G out, fields, G in inputs, ...)
            arranged = chosen.transpose(0, 1).flatten(2, 3)
        else:
            arranged = torch.einsum("oblf,gab->goalf", weight, self.arrangement.to(dtype))
        filters = torch.bmm(arranged.reshape(size, -1, functions), self.basis.to(dtype))
        weights = filters.view(size * self.fields, weight.shape[1], self.depth, taps)
        return self.scale_filters(weights), self.bias.to(dtype).repeat(size)

    def scale_filters(self, filters: Tensor) -> Tensor:
        """Return the filters to use for expanded ones; equivariant layers keep them unchanged."""
        return filters


class FieldConv2d(FieldLayer):
    """Equivariant 3 x 3 convolution with filters of `steerable_basis` or, if `full`, of `pixel_basis`."""

    def __init__(
        self,
        group: PlanarGroup,
        inputs: int | NDArray[np.float64],
        fields: int,
        padding: int,
        full: bool = False,
    ):
        super().__init__(group, inputs, fields, pixel_basis(group) if full else steerable_basis(group))
        self.padding = padding

    def forward(self, images: Tensor, pool: bool = False) -> Tensor:
        """Map (B, channels, H, W) to (B, G fields, H', W'); `pool` appends 2 x 2 max pooling and ReLU."""
        weight, bias = self.expanded()
        result = functional.conv2d(images, weight.view(*weight.shape[:2], 3, 3), bias, padding=self.padding)
        return functional.relu(functional.max_pool2d(result, 2)) if pool else result


class RelaxedConv2d(FieldConv2d):
    """Relaxed group convolution (Wang et al., 2022e) with one filter bank and a learned gain per output block.

    It is equivariant while all gains are equal, as at initialisation.
    """

    def __init__(self, group: PlanarGroup, inputs: int | NDArray[np.float64], fields: int, padding: int):
        super().__init__(group, inputs, fields, padding, full=True)
        self.gains = nn.Parameter(torch.ones(group.size))

    def scale_filters(self, filters: Tensor) -> Tensor:
        """Multiply the filters of each output block by its gain."""
        return filters * self.gains.to(filters.dtype).repeat_interleave(self.fields)[:, None, None, None]

    def asymmetry(self) -> Tensor:
        """Return the sum of absolute differences between all pairs of gains, the relaxation penalty."""
        first, second = torch.triu_indices(len(self.gains), len(self.gains), 1, device=self.gains.device).unbind()
        return (self.gains[first] - self.gains[second]).abs().sum()


class FieldConv3d(FieldLayer):
    """Equivariant `depth` x 3 x 3 convolution of voxel grids, z first; the group acts on the last two axes."""

    def __init__(
        self,
        group: PlanarGroup,
        inputs: int | NDArray[np.float64],
        fields: int,
        padding: tuple[int, int, int],
        depth: int = 3,
    ):
        super().__init__(group, inputs, fields, pixel_basis(group), depth)
        self.padding = padding

    def filters(self) -> tuple[Tensor, Tensor]:
        """Return ordinary filters (G fields, channels, depth, 3, 3) and biases (G fields,)."""
        weight, bias = self.expanded()
        return weight.view(*weight.shape[:3], 3, 3), bias

    def forward(self, voxels: Tensor, pool: bool = False) -> Tensor:
        """Map (B, channels, Z, H, W) to (B, G fields, Z', H', W'); `pool` appends 2 x 2 x 2 max pooling and ReLU."""
        result = functional.conv3d(voxels, *self.filters(), padding=self.padding)
        return functional.relu(functional.max_pool3d(result, 2)) if pool else result


class FieldLinear(FieldLayer):
    """Equivariant linear layer on the last axis."""

    def __init__(self, group: PlanarGroup, inputs: int | NDArray[np.float64], fields: int):
        super().__init__(group, inputs, fields, np.ones((group.size, 1, 1)))

    def forward(self, features: Tensor) -> Tensor:
        """Map (..., channels) to (..., G fields)."""
        weight, bias = self.expanded()
        return functional.linear(features, weight.flatten(1), bias)


def asymmetry(network: nn.Module) -> Tensor:
    """Return the relaxation penalty of a network: the sum of `RelaxedConv2d.asymmetry` over its layers."""
    return torch.stack([layer.asymmetry() for layer in network.modules() if isinstance(layer, RelaxedConv2d)]).sum()


def autocast_dtype(tensor: Tensor) -> torch.dtype:
    """Return the dtype in which convolutions with `tensor` are computed, under autocast or not."""
    kind = tensor.device.type
    return torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else tensor.dtype
