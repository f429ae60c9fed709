"""Group-equivariant layers whose filters are expanded from free weights and handed to ordinary convolutions.

Features are `fields`: one number per element of the group, as G blocks of n channels, the group outermost. When the
scene is transformed by g, block h becomes block g^-1 h. Filters obey the kernel constraint of Cohen et al. (2019) by
construction: the filter of output block g is the one of the identity, transformed by g.
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

RING_WIDTH = 0.4  # pixels; that of escnn's filters of 3 x 3, so that ours are the same functions
FREQUENCIES = 2  # of the ring's angular functions: a square of 3 x 3 pixels holds no more without aliasing
TAPS = 9


def steerable_basis(group: PlanarGroup) -> NDArray[np.float64]:
    """Return the functions that filters of 3 x 3 pixels are sums of, moved by every element: (G, 6, 9), orthonormal.

    The six are the centre pixel and a ring of radius 1 times cos and sin of 0, 1 and 2 times the angle. Function b of
    element g is b(g^-1 x); pixel x is (row, column) = (x, y) of the table.
    """
    moved = _moved_taps(group)
    radius, angle = np.hypot(moved[..., 0], moved[..., 1]), np.arctan2(moved[..., 1], moved[..., 0])
    ring = np.where(radius > 0.5, np.exp(-0.5 * ((radius - 1) / RING_WIDTH) ** 2), 0.0)
    waves = [np.cos(k * angle) for k in range(FREQUENCIES + 1)]
    waves += [np.sin(k * angle) for k in range(1, FREQUENCIES + 1)]
    functions = np.stack([(radius < 0.5).astype(float), *(ring * wave for wave in waves)], axis=1)
    norms = np.linalg.norm(functions[0], axis=-1)  # one norm for all elements: 45 degrees off the grid sums differ
    return (functions / norms[:, None]).round(DECIMALS) + 0.0


def pixel_basis(group: PlanarGroup) -> NDArray[np.float64]:
    """Return single pixels, moved by every element: (G, 9, 9). Filters may then be anything, as in plain networks."""
    if not group.is_exact:
        raise ValueError(f"pixels cannot be turned by {360 / group.turns:g} degrees")
    row, column = np.moveaxis(_moved_taps(group).round().astype(int) + 1, -1, 0)
    return np.eye(TAPS)[:, 3 * row + column].transpose(1, 0, 2)


def _moved_taps(group: PlanarGroup) -> NDArray[np.float64]:
    """Return g^-1 x for every element g and pixel x of a filter: (G, 9, 2)."""
    taps = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), axis=-1).reshape(TAPS, 2)
    return np.einsum("gij,ti->gtj", group.rotation(), taps)  # the inverse of an orthogonal matrix is its transpose


class FieldLayer(nn.Module):
    """What equivariant layers share: free weights per pair of fields, arranged into one filter per output block.

    Args:
        group: G elements.
        inputs: number of input fields, or (G, d, d) the representation of d input channels that are not fields.
        fields: output fields n.
        basis: (G, functions, taps), how each element moves the functions that filters are sums of.
        layers: stacked taps that no element moves: pixels along the vertical.
    """

    basis: Tensor
    arrangement: Tensor

    def __init__(
        self,
        group: PlanarGroup,
        inputs: int | NDArray[np.float64],
        fields: int,
        basis: NDArray[np.float64],
        layers: int = 1,
    ):
        super().__init__()
        self.group, self.fields, self.layers = group, fields, layers
        self.has_field_inputs = isinstance(inputs, int)
        dtype = torch.get_default_dtype()
        self.register_buffer("basis", torch.tensor(basis, dtype=dtype), persistent=False)
        channels = inputs * group.size if isinstance(inputs, int) else inputs.shape[-1]
        arrangement = torch.tensor(group.quotient if isinstance(inputs, int) else inputs.round(DECIMALS))
        self.register_buffer(
            "arrangement", arrangement if self.has_field_inputs else arrangement.to(dtype), persistent=False
        )
        free = channels * layers * basis.shape[1]
        self.weight = nn.Parameter(torch.empty(fields, channels, layers * basis.shape[1]))
        nn.init.normal_(self.weight, std=math.sqrt(2 / free))  # He et al. (2015): the basis is orthonormal
        self.bias = nn.Parameter(torch.zeros(fields))
        self._kept: tuple[Any, tuple[Tensor, ...]] | None = None

    def train(self, mode: bool = True) -> Self:
        """Switch between training and evaluation, which forgets what was kept."""
        if mode != self.training:
            self._kept = None
        return super().train(mode)

    def expanded(self) -> tuple[Tensor, ...]:
        """Return ordinary weights (G fields, channels, layers, taps) and biases (G fields,)."""
        return self.kept(self._expand)

    def kept(self, compute: Callable[[], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """Return what is computed from the weights; without gradients it is kept until these change.

        PyTorch does not count changes through `parameter.data`: they are seen after the next switch between `train()`
        and `eval()`.
        """
        if torch.is_grad_enabled():
            self._kept = None
            return compute()
        versions = [(parameter._version, parameter.data_ptr()) for parameter in self.parameters()]
        state = (compute.__name__, versions, autocast_dtype(self.weight))
        if self._kept is None or self._kept[0] != state:
            self._kept = (state, compute())
        return self._kept[1]

    def _expand(self) -> tuple[Tensor, Tensor]:
        dtype = autocast_dtype(self.weight)
        size, functions, taps = self.basis.shape
        weight = self.weight.to(dtype).view(self.fields, -1, self.layers, functions)
        if self.has_field_inputs:
            blocks = weight.view(self.fields, size, -1, self.layers, functions)
            # blocks[:, self.arrangement], but that sums its gradient in any order
            chosen = blocks.index_select(1, self.arrangement.flatten()).view(self.fields, size, *blocks.shape[1:])
            # (fields, G out, G in, inputs, ...), then the output's element first
            arranged = chosen.transpose(0, 1).flatten(2, 3)
        else:
            arranged = torch.einsum("oblf,gab->goalf", weight, self.arrangement.to(dtype))
        filters = torch.bmm(arranged.reshape(size, -1, functions), self.basis.to(dtype))
        weights = filters.view(size * self.fields, weight.shape[1], self.layers, taps)
        return self.gain(weights), self.bias.to(dtype).repeat(size)

    def gain(self, weights: Tensor) -> Tensor:
        """Return what becomes of expanded weights; nothing, if the layer is to be equivariant."""
        return weights


class FieldConv2d(FieldLayer):
    """Equivariant convolution of 3 x 3 pixels; `full` filters are of all nine, others of `steerable_basis`."""

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
        """Map (B, channels, H, W) to (B, G fields, H', W'); `pool` appends the maximum of 2 x 2 pixels and ReLU."""
        weight, bias = self.expanded()
        result = functional.conv2d(images, weight.view(*weight.shape[:2], 3, 3), bias, padding=self.padding)
        return functional.relu(functional.max_pool2d(result, 2)) if pool else result


class RelaxedConv2d(FieldConv2d):
    """Relaxed group convolution (Wang et al., 2022e) with one filter bank: every output block has a learned gain.

    It is equivariant while all gains are equal, as they are at the start.
    """

    def __init__(self, group: PlanarGroup, inputs: int | NDArray[np.float64], fields: int, padding: int):
        super().__init__(group, inputs, fields, padding, full=True)
        self.gains = nn.Parameter(torch.ones(group.size))

    def gain(self, weights: Tensor) -> Tensor:
        """Scale each output block by its gain."""
        return weights * self.gains.to(weights.dtype).repeat_interleave(self.fields)[:, None, None, None]

    def asymmetry(self) -> Tensor:
        """Return the sum of the differences between gains, which training keeps small."""
        first, second = torch.triu_indices(len(self.gains), len(self.gains), 1, device=self.gains.device).unbind()
        return (self.gains[first] - self.gains[second]).abs().sum()


class FieldConv3d(FieldLayer):
    """Equivariant convolution of `layers` x 3 x 3 voxels, z first; the group moves the last two axes only."""

    def __init__(
        self,
        group: PlanarGroup,
        inputs: int | NDArray[np.float64],
        fields: int,
        padding: tuple[int, int, int],
        layers: int = 3,
    ):
        super().__init__(group, inputs, fields, pixel_basis(group), layers)
        self.padding = padding

    def forward(self, voxels: Tensor, pool: bool = False) -> Tensor:
        """Map (B, channels, Z, H, W) to (B, G fields, Z', H', W'); `pool` as in two dimensions, with 2 x 2 x 2."""
        weight, bias = self.expanded()
        result = functional.conv3d(voxels, weight.view(*weight.shape[:3], 3, 3), bias, padding=self.padding)
        return functional.relu(functional.max_pool3d(result, 2)) if pool else result


class FieldLinear(FieldLayer):
    """Equivariant linear map of the last axis: (..., channels) to (..., G fields)."""

    def __init__(self, group: PlanarGroup, inputs: int | NDArray[np.float64], fields: int):
        super().__init__(group, inputs, fields, np.ones((group.size, 1, 1)))

    def forward(self, features: Tensor) -> Tensor:
        """Apply the map."""
        weight, bias = self.expanded()
        return functional.linear(features, weight.flatten(1), bias)


def asymmetry(network: nn.Module) -> Tensor:
    """Return how far the relaxed layers of a network are from equivariance."""
    return torch.stack([layer.asymmetry() for layer in network.modules() if isinstance(layer, RelaxedConv2d)]).sum()


def autocast_dtype(tensor: Tensor) -> torch.dtype:
    """Return the type that convolutions of `tensor` are computed in."""
    kind = tensor.device.type
    return torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else tensor.dtype
