"""The encoder of point clouds: PointNet++ (Qi et al., 2017) with equivariant layers (paper A.4)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.nn.encoders.base import Encoder
from lerobot_policy_symview.nn.encoders.convolutional import with_trivial
from lerobot_policy_symview.nn.layers import FieldLinear
from lerobot_policy_symview.symmetry.groups import PlanarGroup, block_diagonal

UNIT = 0.1  # metres; coordinates are divided by it, so that they are of the order of one


class PointEncoder(Encoder):
    """Three set abstractions at two scales, then a global set abstraction; 1.2 M parameters at width 64.

    Args:
        group: G elements.
        channels: invariant channels of a point: 3 of colour, and whether it is the gripper's where it is drawn.
        state: (G, D, D), representation of the state vector, which is repeated at every point.
        width: n, output fields of the global set abstraction.
    """

    def __init__(self, group: PlanarGroup, channels: int, state: NDArray[np.float64], width: int):
        super().__init__(group, width)
        color_and_state = with_trivial(group, channels, state)
        quarter, half = width // 4, width // 2
        self.abstractions = nn.ModuleList(
            [
                SetAbstraction(group, color_and_state, 256, (0.03, 0.06), 16, (quarter, quarter, half)),
                SetAbstraction(group, 2 * half, 64, (0.06, 0.12), 16, (half, half, width)),
                SetAbstraction(group, 2 * width, 16, (0.12, 0.24), 16, (width, 3 * width // 2, 2 * width)),
            ]
        )
        self.global_mlp = FieldMlp(group, 4 * width, (2 * width, 4 * width, width))

    def forward(self, observation: Tensor, state: Tensor) -> Tensor:
        """Map points (B, P, 3 + channels), x, y, z in metres first, and states (B, D) to features (B, G, n)."""
        position = observation[..., :3] / UNIT
        features = torch.cat([observation[..., 3:], state[:, None].expand(-1, observation.shape[1], -1)], dim=-1)
        for abstraction in self.abstractions:
            position, features = abstraction(position, features)
        pooled = self.global_mlp(features, position).amax(dim=1)
        return self.split(pooled)


class FieldMlp(nn.Module):
    """Equivariant multi-layer perceptron of a point's features and its offset (x, y, z) from a centre.

    Every layer is followed by layer normalisation and ReLU. The statistics of a point's channels are invariant, and
    averaged and target networks need no running ones, as they would for PointNet++'s batch normalisation.
    """

    def __init__(self, group: PlanarGroup, inputs: int | NDArray[np.float64], fields: Sequence[int]):
        super().__init__()
        offset = block_diagonal([group.rotation(), np.ones((group.size, 1, 1))])
        self.from_offset = FieldLinear(group, offset, fields[0])
        self.from_features = FieldLinear(group, inputs, fields[0])
        self.layers = nn.ModuleList(FieldLinear(group, before, after) for before, after in itertools.pairwise(fields))

    def forward(self, features: Tensor, offset: Tensor, index: Tensor | None = None) -> Tensor:
        """Map features (B, P, channels), gathered at `index` (B, ...), and offsets (B, ..., 3) to (B, ..., G n)."""
        gathered = self.from_features(features)
        if index is not None:  # after the linear map, which commutes with it: there are fewer points than neighbours
            gathered = _gather(gathered, index)
        hidden = normalized_relu(gathered + self.from_offset(offset))
        for layer in self.layers:
            hidden = normalized_relu(layer(hidden))
        return hidden


def normalized_relu(features: Tensor) -> Tensor:
    """Return the ReLU of features (..., channels), normalised over the channels."""
    return functional.relu(functional.layer_norm(features, features.shape[-1:]))


class SetAbstraction(nn.Module):
    """Set abstraction with multi-scale grouping: max pooling over the neighbourhoods of sampled points.

    Args:
        group: G elements.
        inputs: number of input fields, or the representation of the input channels, as for `FieldLayer`.
        centers: number of points that farthest point sampling keeps.
        radii: radii of the neighbourhoods, metres.
        neighbors: most points of a neighbourhood.
        fields: output fields of each layer, the same for every radius.
    """

    def __init__(
        self,
        group: PlanarGroup,
        inputs: int | NDArray[np.float64],
        centers: int,
        radii: Sequence[float],
        neighbors: int,
        fields: Sequence[int],
    ):
        super().__init__()
        self.group, self.centers, self.radii, self.neighbors = group, centers, radii, neighbors
        self.scales = nn.ModuleList(FieldMlp(group, inputs, fields) for _ in radii)

    def forward(self, position: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """Map positions (B, P, 3) and features (B, P, channels) to those of C centres, (B, C, ...)."""
        centers = _gather(position, farthest_points(position, self.centers))
        squared = _squared_distances(centers, position)
        pooled_scales = []
        for radius, mlp in zip(self.radii, self.scales, strict=True):
            index = neighborhoods(squared, radius / UNIT, self.neighbors)
            offset = _gather(position, index) - centers[:, :, None]
            pooled = mlp(features, offset, index).amax(dim=2)
            pooled_scales.append(pooled.view(*pooled.shape[:2], self.group.size, -1))
        return centers, torch.cat(pooled_scales, dim=-1).flatten(-2)


def farthest_points(position: Tensor, count: int) -> Tensor:
    """Return the indices (B, count) of a farthest point sample of points (B, P, 3) that starts at the first point."""
    chosen = [torch.zeros(position.shape[0], dtype=torch.long, device=position.device)]
    nearest = position.new_full(position.shape[:2], torch.inf)
    for _ in range(count - 1):
        last = _gather(position, chosen[-1][:, None])
        nearest = torch.minimum(nearest, _squared_distances(last, position)[:, 0])
        chosen.append(nearest.argmax(dim=1))
    return torch.stack(chosen, dim=1)


def neighborhoods(squared: Tensor, radius: float, count: int) -> Tensor:
    """Return points within `radius` of each centre (ball query): the first `count` in the order of the points.

    Points are in a random order, or in that of farthest point sampling, so that the first ones fill the ball; the
    nearest ones would be the same at all radii where points are dense.

    Args:
        squared: (B, C, P) squared distances of P points from C centres, each of which is one of the points.
        radius: in the unit of the positions.
        count: points per neighbourhood; where there are fewer, the first one fills the places.

    Returns:
        (B, C, count) indices of points.
    """
    points = squared.shape[-1]
    order = torch.arange(points, dtype=squared.dtype, device=squared.device)
    first = torch.where(squared <= radius**2, order, points).topk(count, dim=-1, largest=False).values.long()
    return torch.where(first < points, first, first[..., :1].clamp(max=points - 1))  # none is near if all are NaN


def _squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """Return (B, A, P) for points (B, A, 3) and (B, P, 3).

    Differences are bit-identical under quarter turns, which the expansion by a matrix product is not.
    """
    x, y, z = (a[:, :, None, axis] - b[:, None, :, axis] for axis in range(3))
    return (x * x + y * y) + z * z


def _gather(values: Tensor, index: Tensor) -> Tensor:
    """Return values (B, P, F) at index (B, ...): (B, ..., F)."""
    flat = index.flatten(1)[..., None].expand(-1, -1, values.shape[-1])
    return values.gather(1, flat).view(*index.shape, values.shape[-1])


def point_cloud(config: SymviewConfig, group: PlanarGroup, state: NDArray[np.float64]) -> Encoder:
    """Return the encoder of point clouds."""
    return PointEncoder(group, config.channels, state, config.width)
