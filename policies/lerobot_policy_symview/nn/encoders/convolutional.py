"""The encoders of images and voxels, and the registry `--policy.encoder` chooses from.

The plain network is the equivariant one's layout for the group of one element.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.inputs.voxels import VOXEL_CHANNELS
from lerobot_policy_symview.nn.encoders.base import Encoder
from lerobot_policy_symview.nn.fourier_conv import FourierConv2d
from lerobot_policy_symview.nn.layers import FieldConv2d, FieldConv3d, RelaxedConv2d
from lerobot_policy_symview.symmetry.groups import PlanarGroup, block_diagonal

CHANNELS_LAST = {2: torch.channels_last, 3: torch.channels_last_3d}
Convolution = Callable[[PlanarGroup, int | NDArray[np.float64], int, int], nn.Module]


class ConvolutionalEncoder(Encoder):
    """Convolutions, some followed by the maximum of 2 pixels along every axis, each by ReLU, down to one pixel.

    Args:
        group: G elements.
        fields: n.
        layers: the convolutions; with a second argument True they append maximum and ReLU.
        pooled: which of them do.
    """

    def __init__(self, group: PlanarGroup, fields: int, layers: Sequence[nn.Module], pooled: Sequence[bool]):
        super().__init__(group, fields)
        self.layers, self.pooled = nn.ModuleList(layers), list(pooled)

    def forward(self, picture: Tensor, state: Tensor) -> Tensor:
        """Map pictures (B, C, size, size), or voxels (B, C, Z, X, Y), and states (B, D) to features (B, G, n)."""
        shape = picture.shape[2:]
        constants = state.reshape(*state.shape, *[1] * len(shape)).expand(-1, -1, *shape)
        features = torch.cat([picture, constants], dim=1)
        if torch.is_autocast_enabled(features.device.type) or features.is_cuda:
            features = features.contiguous(memory_format=CHANNELS_LAST[len(shape)])
        for layer, pool in zip(self.layers, self.pooled, strict=True):
            features = layer(features, pool)
            if not pool:
                features = functional.relu(features)
        return self.split(features)


class ImageEncoder(ConvolutionalEncoder):
    """Seven convolutions from 128 px to one, six from 64 px (paper A.4; 1,112,680 parameters for five channels).

    Args:
        group: G elements.
        channels: of the picture, each a scalar field on the table.
        state: (G, D, D), the representation of the state, which every pixel gets.
        stages: fields of the convolutions that each halve the image, down to 8 px.
        fields: of the last three convolutions.
        convolution: makes a layer of a group, inputs, fields and padding.
    """

    def __init__(
        self,
        group: PlanarGroup,
        channels: int,
        state: NDArray[np.float64],
        stages: list[int],
        fields: tuple[int, int, int],
        convolution: Convolution = FieldConv2d,
    ):
        inputs: list[int | NDArray[np.float64]] = [scalars(group, channels, state), *stages, *fields[:-1]]
        paddings = [1] * (len(stages) + 1) + [0, 0]
        layers = [
            convolution(group, before, after, padding)
            for before, after, padding in zip(inputs, [*stages, *fields], paddings, strict=True)
        ]
        super().__init__(group, fields[-1], layers, [True] * len(stages) + [False, True, False])


class VoxelEncoder(ConvolutionalEncoder):
    """The image encoder in three dimensions, for 32 x 64 x 64 voxels; turns and mirrors move the last two axes.

    Args:
        group: G elements.
        state: (G, D, D), the representation of the state, which every voxel gets.
        width: n of the corresponding image encoder; 64 gives 1.18 M parameters.
    """

    def __init__(self, group: PlanarGroup, state: NDArray[np.float64], width: int):
        fields = [width // 16, width // 8, width // 4, width // 2, width, width // 2, width // 2]
        inputs: list[int | NDArray[np.float64]] = [scalars(group, VOXEL_CHANNELS, state), *fields[:-1]]
        paddings = [(1, 1, 1)] * 5 + [(1, 0, 0), (0, 0, 0)]
        heights = [3] * 6 + [2]
        layers = [
            FieldConv3d(group, before, after, padding, height)
            for before, after, padding, height in zip(inputs, fields, paddings, heights, strict=True)
        ]
        super().__init__(group, fields[-1], layers, [True, True, True, False, False, True, False])


def scalars(group: PlanarGroup, count: int, others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the representation of `count` scalars followed by `others` (G, D, D)."""
    return block_diagonal([np.ones((group.size, 1, 1))] * count + [others])


def _stages(config: SymviewConfig) -> list[int]:
    n = config.width
    return {128: [n // 8, n // 4, n // 2, n], 64: [n // 4, n // 2, n]}[config.crop_size]


def _full(group: PlanarGroup, inputs: int | NDArray[np.float64], fields: int, padding: int) -> FieldConv2d:
    return FieldConv2d(group, inputs, fields, padding, full=True)


def equivariant(config: SymviewConfig, group: PlanarGroup, state: NDArray[np.float64]) -> Encoder:
    """Return the equivariant image encoder."""
    fields = (2 * config.width, config.width, config.width)
    return ImageEncoder(group, config.channels, state, _stages(config), fields, FourierConv2d)


def relaxed(config: SymviewConfig, group: PlanarGroup, state: NDArray[np.float64]) -> Encoder:
    """Return the image encoder of relaxed group convolutions."""
    fields = (2 * config.width, config.width, config.width)
    return ImageEncoder(group, config.channels, state, _stages(config), fields, RelaxedConv2d)


def plain(config: SymviewConfig, group: PlanarGroup, state: NDArray[np.float64]) -> Encoder:
    """Return the lineage's 16, 32, 64, 128, 128, 256, 256 channels at the paper's size: 1.13 M parameters."""
    stages = [2 * fields for fields in _stages(config)]
    fields = (2 * config.width, 4 * config.width, 4 * config.width)
    return ImageEncoder(group, config.channels, state, stages, fields, _full)


def voxel(config: SymviewConfig, group: PlanarGroup, state: NDArray[np.float64]) -> Encoder:
    """Return the encoder of voxels."""
    return VoxelEncoder(group, state, config.width)
