"""PointNet++ (Qi et al., 2017) with equivariant layers (paper A.4)."""

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
from lerobot_policy_symview.nn.layers import FieldLinear
from lerobot_policy_symview.symmetry.groups import PlanarGroup, block_diagonal

POINTS = 1024
UNIT = 0.1  # metres: what coordinates are divided by, so that they are of the order of one


class PointEncoder(Encoder):
    """Three set abstractions at two scales and one over all points; 1.2 M parameters at width 64.

    Args:
        group: G elements.
        state: (G, D, D), the representation of the state, which every point gets.
        width: of the last set abstraction, in fields.
    """

    def __init__(self, group: PlanarGroup, state: NDArray[np.float64], width: int):
        super().__init__(group, width)
        color_and_state = block_diagonal([np.ones((group.size, 1, 1))] * 3 + [state])
        quarter, half = width // 4, width // 2
        self.abstractions = nn.ModuleList(
            [
                SetAbstraction(group, color_and_state, 256, (0.03, 0.06), 16, (quarter, quarter, half)),
                SetAbstraction(group, 2 * half, 64, (0.06, 0.12), 16, (half, half, width)),
                SetAbstraction(group, 2 * width, 16, (0.12, 0.24), 16, (width, 3 * width // 2, 2 * width)),
            ]
        )
        self.whole = FieldMlp(group, 4 * width, (2 * width, 4 * width, width))

    def forward(self, points: Tensor, state: Tensor) -> Tensor:
        """Map points (B, P, 6) of x, y, z in metres and colour, and states (B, D), to features (B, G, n)."""
        position = points[..., :3] / UNIT
        features = torch.cat([points[..., 3:], state[:, None].expand(-1, points.shape[1], -1)], dim=-1)
        for abstraction in self.abstractions:
            position, features = abstraction(position, features)
        pooled = self.whole(features, position).amax(dim=1)
        return self.split(pooled)


class FieldMlp(nn.Module):
    """Equivariant layers with ReLU of features and, in the first, an offset (x, y, z)."""

    def __init__(self, group: PlanarGroup, inputs: int | NDArray[np.float64], fields: Sequence[int]):
        super().__init__()
        offset = block_diagonal([group.rotation(), np.ones((group.size, 1, 1))])
        self.of_offset = FieldLinear(group, offset, fields[0])
        self.of_features = FieldLinear(group, inputs, fields[0])
        self.rest = nn.ModuleList(FieldLinear(group, before, after) for before, after in itertools.pairwise(fields))

    def forward(self, features: Tensor, offset: Tensor, index: Tensor | None = None) -> Tensor:
        """Map features (B, P, channels), chosen by `index` (B, ...), and offsets (B, ..., 3) to (B, ..., G fields)."""
        chosen = self.of_features(features)
        if index is not None:  # after the linear map, which commutes with choosing: points are fewer than neighbours
            chosen = _rows(chosen, index)
        hidden = functional.relu(chosen + self.of_offset(offset))
        for layer in self.rest:
            hidden = functional.relu(layer(hidden))
        return hidden


class SetAbstraction(nn.Module):
    """Summarises the neighbourhoods of some of the points, at several radii (multi-scale grouping).

    Args:
        group: G elements.
        inputs: of the points' features, as for the layers.
        centers: how many points are kept, each as far as possible from those before.
        radii: of the neighbourhoods, metres.
        neighbors: how many points a neighbourhood has at most.
        fields: of the layers, for each radius.
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
        """Map positions (B, P, 3) and features (B, P, channels) to the centres', the scales' fields side by side."""
        centers = _rows(position, farthest_points(position, self.centers))
        squared = _squared_distances(centers, position)
        nearest_first = squared.topk(self.neighbors, dim=-1, largest=False)
        summaries = []
        for radius, mlp in zip(self.radii, self.scales, strict=True):
            index = neighborhoods(nearest_first, radius / UNIT)
            offset = _rows(position, index) - centers[:, :, None]
            summary = mlp(features, offset, index).amax(dim=2)
            summaries.append(summary.view(*summary.shape[:2], self.group.size, -1))
        return centers, torch.cat(summaries, dim=-1).flatten(-2)


def farthest_points(position: Tensor, count: int) -> Tensor:
    """Choose `count` of the points (B, P, 3), the first and then each the farthest from those chosen: (B, count)."""
    chosen = [torch.zeros(len(position), dtype=torch.long, device=position.device)]
    nearest = position.new_full(position.shape[:2], torch.inf)
    for _ in range(count - 1):
        last = _rows(position, chosen[-1][:, None])
        nearest = torch.minimum(nearest, _squared_distances(last, position)[:, 0])
        chosen.append(nearest.argmax(dim=1))
    return torch.stack(chosen, dim=1)


def neighborhoods(nearest_first: tuple[Tensor, Tensor], radius: float) -> Tensor:
    """Return the points within `radius` of each centre, the nearest in place of those beyond.

    Args:
        nearest_first: squared distances (B, C, K) in ascending order, and the points they belong to.
        radius: in the unit of the distances' roots.

    Returns:
        (B, C, K) indices of points.
    """
    squared, index = nearest_first
    return torch.where(squared <= radius**2, index, index[..., :1])


def _squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """(B, A, 3) and (B, P, 3) to (B, A, P), by differences: a quarter turn changes no bit, unlike a matrix product."""
    x, y, z = (a[:, :, None, axis] - b[:, None, :, axis] for axis in range(3))
    return (x * x + y * y) + z * z


def _rows(values: Tensor, index: Tensor) -> Tensor:
    """Return values (B, P, F) at index (B, ...): (B, ..., F)."""
    flat = index.flatten(1)[..., None].expand(-1, -1, values.shape[-1])
    return values.gather(1, flat).view(*index.shape, values.shape[-1])


def point_cloud(config: SymviewConfig, group: PlanarGroup, state: NDArray[np.float64]) -> Encoder:
    """Return the encoder of point clouds."""
    return PointEncoder(group, state, config.width)
