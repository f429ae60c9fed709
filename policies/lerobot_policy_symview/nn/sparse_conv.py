"""Convolution and max pooling of voxel grids that are almost empty, computed where they are not.

A camera sees surfaces: about one voxel in thirty is occupied. Elsewhere, the result is that of an empty grid, which
differs only at the faces, edges and corners of the grid. It is computed once, on a grid of a few voxels, and copied.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

WINDOW = 4  # voxels per axis that a 3 x 3 x 3 convolution and 2 x 2 x 2 pooling map to one voxel


class SparseGrid(NamedTuple):
    """A voxel grid, most of whose voxels have the values of an empty grid."""

    values: Tensor
    """(B, Z, X, Y, C)."""
    active: Tensor
    """(B, 1, Z, X, Y) float, 1 where the values may differ from the empty grid's."""
    empty: Tensor
    """(B, C, 3k, 3k, 3k), the values of an empty grid of that size."""


def conv_and_pool(grid: SparseGrid, weight: Tensor, bias: Tensor) -> SparseGrid:
    """Return the 3 x 3 x 3 convolution with padding 1, 2 x 2 x 2 max pooling and ReLU of a grid.

    Args:
        grid: Z, X, Y and 3k are even.
        weight: (O, C, 3, 3, 3).
        bias: (O,).
    """
    active = functional.max_pool3d(grid.active, WINDOW, stride=2, padding=1)
    empty = functional.relu(functional.max_pool3d(functional.conv3d(grid.empty, weight, bias, padding=1), 2))
    cells = active[:, 0].nonzero()
    outputs = weight.shape[0]
    windows = _windows(grid.values, cells).to(weight.dtype)
    pooled = (windows @ _in_windows(weight)).view(-1, 8, outputs).amax(1)
    values = _enlarged(empty.to(pooled.dtype), active.shape[2:]).movedim(1, -1)  # under autocast, pooling is float32
    values = values.index_put(tuple(cells.unbind(1)), functional.relu(pooled + bias))
    return SparseGrid(values, active, empty)


def _windows(values: Tensor, cells: Tensor) -> Tensor:
    """Return the windows (N, 64 C) of a grid (B, Z, X, Y, C) that the pooled voxels `cells` (N, 4: b, z, x, y) see."""
    padded = functional.pad(values, [0, 0] + [1] * 6)
    sizes = padded.shape[1:4]
    first = cells[:, 0]
    for axis, size in enumerate(sizes):
        first = first * size + 2 * cells[:, axis + 1]
    z, x, y = torch.meshgrid(*[torch.arange(WINDOW, device=values.device)] * 3, indexing="ij")
    offsets = ((z * sizes[1] + x) * sizes[2] + y).flatten()
    voxels = (first[:, None] + offsets).flatten()
    # not padded[voxels], whose backward pass is ten times slower; on CUDA its gradients may differ in their last bits
    return padded.flatten(0, 3).index_select(0, voxels).view(len(cells), WINDOW**3 * values.shape[-1])


def _in_windows(weight: Tensor) -> Tensor:
    """Return the filters (O, C, 3, 3, 3) at the eight places of a window: (64 C, 8 O)."""
    places = [
        functional.pad(weight, [y, 1 - y, x, 1 - x, z, 1 - z]) for z in range(2) for x in range(2) for y in range(2)
    ]
    return torch.stack(places).permute(3, 4, 5, 2, 0, 1).flatten(0, 3).flatten(1)


def _enlarged(empty: Tensor, sizes: torch.Size) -> Tensor:
    """Return an empty grid of other `sizes`, which has the same faces, edges and corners and repeats the inside."""
    for axis, size in enumerate(sizes, start=2):
        index = torch.ones(size, dtype=torch.long, device=empty.device)
        index[0], index[-1] = 0, empty.shape[axis] - 1
        empty = empty.index_select(axis, index)
    return empty
