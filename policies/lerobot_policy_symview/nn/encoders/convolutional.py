"""Convolutional encoders of images.

The plain encoder has the layout of the equivariant encoder for the trivial group.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.nn.encoders.base import Encoder
from lerobot_policy_symview.nn.fourier_conv import FourierConv2d
from lerobot_policy_symview.nn.layers import FieldConv2d, RelaxedConv2d
from lerobot_policy_symview.symmetry.groups import PlanarGroup, block_diagonal

CHANNELS_LAST = {2: torch.channels_last, 3: torch.channels_last_3d}
Convolution = Callable[[PlanarGroup, int | NDArray[np.float64], int, int], nn.Module]
"""Makes a layer from a group, its input (a number of fields, or a representation), its output fields and a padding."""


class ConvolutionalEncoder(Encoder):
    """Convolutions with ReLU, some of them with 2 x 2 (x 2) max pooling, down to a single pixel.

    Args:
        group: G elements.
        fields: n, of the last convolution.
        layers: the convolutions; called with a second argument True, they append max pooling and ReLU.
        pooled: for each convolution, whether it is pooled.
    """

    def __init__(self, group: PlanarGroup, fields: int, layers: Sequence[nn.Module], pooled: Sequence[bool]):
        super().__init__(group, fields)
        self.layers, self.pooled = nn.ModuleList(layers), list(pooled)

    def forward(self, observation: Tensor, state: Tensor) -> Tensor:
        """Map images (B, C, size, size), or voxel grids (B, C, Z, X, Y), and states (B, D) to features (B, G, n)."""
        shape = observation.shape[2:]
        state_channels = state.reshape(*state.shape, *[1] * len(shape)).expand(-1, -1, *shape)
        features = torch.cat([observation, state_channels], dim=1)
        if torch.is_autocast_enabled(features.device.type) or features.is_cuda:
            features = features.contiguous(memory_format=CHANNELS_LAST[len(shape)])
        return self.split(self.run(features))

    def run(self, features: Tensor, first: int = 0) -> Tensor:
        """Return the features (B, G n, 1, ...) after the layers from number `first` on."""
        for layer, pool in zip(self.layers[first:], self.pooled[first:], strict=True):
            features = layer(features, pool)
            if not pool:
                features = functional.relu(features)
        return features


class ImageEncoder(ConvolutionalEncoder):
    """Seven 3 x 3 convolutions for 128 px, six for 64 px (paper A.4; 1,112,680 parameters for five channels).

    Args:
        group: G elements.
        channels: image channels, each in the trivial representation.
        state: (G, D, D), representation of the state vector, which is repeated at every pixel.
        stages: output fields of the convolutions that are pooled, down to 8 px.
        fields: output fields of the last three convolutions.
        convolution: makes the layers.
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
        inputs: list[int | NDArray[np.float64]] = [with_trivial(group, channels, state), *stages, *fields[:-1]]
        paddings = [1] * (len(stages) + 1) + [0, 0]
        layers = [
            convolution(group, before, after, padding)
            for before, after, padding in zip(inputs, [*stages, *fields], paddings, strict=True)
        ]
        super().__init__(group, fields[-1], layers, [True] * len(stages) + [False, True, False])


def with_trivial(group: PlanarGroup, count: int, others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the direct sum of `count` trivial representations and `others` (G, D, D)."""
    return block_diagonal([np.ones((group.size, 1, 1))] * count + [others])


def equivariant(config: SymviewConfig, group: PlanarGroup, state: NDArray[np.float64]) -> Encoder:
    """Return the paper's equivariant encoder, in the Fourier domain on a CPU."""
    return _image_encoder(config, group, state, FourierConv2d)


def relaxed(config: SymviewConfig, group: PlanarGroup, state: NDArray[np.float64]) -> Encoder:
    """Return the encoder of relaxed group convolutions, which training may make less than equivariant."""
    return _image_encoder(config, group, state, RelaxedConv2d)


def plain(config: SymviewConfig, group: PlanarGroup, state: NDArray[np.float64]) -> Encoder:
    """Return the encoder without symmetry.

    At the paper's size it has 16, 32, 64, 128, 128, 256, 256 channels and 1.13 M parameters.
    """
    stages = [2 * fields for fields in _stages(config)]
    fields = (2 * config.width, 4 * config.width, 4 * config.width)
    return ImageEncoder(group, config.channels, state, stages, fields, _unconstrained)


def _image_encoder(
    config: SymviewConfig, group: PlanarGroup, state: NDArray[np.float64], convolution: Convolution
) -> Encoder:
    fields = (2 * config.width, config.width, config.width)
    return ImageEncoder(group, config.channels, state, _stages(config), fields, convolution)


def _stages(config: SymviewConfig) -> list[int]:
    n = config.width
    return {128: [n // 8, n // 4, n // 2, n], 64: [n // 4, n // 2, n]}[config.crop_size]


def _unconstrained(group: PlanarGroup, inputs: int | NDArray[np.float64], fields: int, padding: int) -> FieldConv2d:
    return FieldConv2d(group, inputs, fields, padding, full=True)
