"""Convolutional encoder of voxel grids."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.nn.encoders.base import Encoder
from lerobot_policy_symview.nn.encoders.convolutional import ConvolutionalEncoder, with_trivial
from lerobot_policy_symview.nn.layers import FieldConv3d
from lerobot_policy_symview.nn.sparse_conv import SparseGrid, conv_and_pool
from lerobot_policy_symview.symmetry.groups import PlanarGroup
from lerobot_symview.views.tracing import is_exporting

SPARSE_LAYERS = 2  # the first; after them a grid has a few hundred voxels


class VoxelEncoder(ConvolutionalEncoder):
    """The image encoder in three dimensions, for grids of 32 x 64 x 64 voxels; the group acts on the last two axes.

    The first two convolutions are computed near occupied voxels only; an export records the whole convolutions.

    Args:
        group: G elements.
        channels: invariant channels: occupancy, 3 of colour, and the gripper where it is drawn.
        state: (G, D, D), representation of the state vector, which is repeated at every voxel.
        width: n of the corresponding image encoder; 64 gives 1.18 M parameters.
    """

    def __init__(self, group: PlanarGroup, channels: int, state: NDArray[np.float64], width: int):
        fields = [width // 16, width // 8, width // 4, width // 2, width, width // 2, width // 2]
        inputs: list[int | NDArray[np.float64]] = [with_trivial(group, channels, state), *fields[:-1]]
        paddings = [(1, 1, 1)] * 5 + [(1, 0, 0), (0, 0, 0)]
        depths = [3] * 6 + [2]
        layers = [
            FieldConv3d(group, before, after, padding, depth)
            for before, after, padding, depth in zip(inputs, fields, paddings, depths, strict=True)
        ]
        super().__init__(group, fields[-1], layers, [True, True, True, False, False, True, False])

    def forward(self, observation: Tensor, state: Tensor) -> Tensor:
        """Map voxel grids (B, C, Z, X, Y), whose empty voxels are zero, and states (B, D) to features (B, G, n)."""
        if is_exporting():
            return super().forward(observation, state)
        grid = _sparse_grid(observation, state)
        for layer in self.layers[:SPARSE_LAYERS]:
            assert isinstance(layer, FieldConv3d)
            grid = conv_and_pool(grid, *layer.filters())
        return self.split(self.run(grid.values.movedim(-1, 1), SPARSE_LAYERS))


def _sparse_grid(observation: Tensor, state: Tensor) -> SparseGrid:
    batch, channels, *sizes = observation.shape
    side = 3 * 2**SPARSE_LAYERS
    active = (observation != 0).any(dim=1, keepdim=True).to(observation.dtype)
    state_channels = state[:, None, None, None]
    values = [observation.movedim(1, -1), state_channels.expand(-1, *sizes, -1)]
    empty = [observation.new_zeros(batch, side, side, side, channels), state_channels.expand(-1, side, side, side, -1)]
    return SparseGrid(torch.cat(values, dim=-1), active, torch.cat(empty, dim=-1).movedim(-1, 1))


def voxel(config: SymviewConfig, group: PlanarGroup, state: NDArray[np.float64]) -> Encoder:
    """Return the encoder of voxel grids."""
    return VoxelEncoder(group, config.channels, state, config.width)
