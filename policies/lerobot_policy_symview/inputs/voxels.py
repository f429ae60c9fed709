"""Voxel grids of the working volume: occupancy and colour (paper A.4: 64 x 64 x 32 voxels of 0.625 cm)."""

from __future__ import annotations

import torch
from torch import Tensor

from lerobot_policy_symview.inputs.clouds import Cloud
from lerobot_symview.geometry.workspace import Workspace

SIDE = 64
HEIGHT = 32
VOXEL_CHANNELS = 4


def voxelize(cloud: Cloud, workspace: Workspace) -> Tensor:
    """Return voxel grids (B, 4, 32, 64, 64) float32: occupancy (0 or 1) and the mean RGB of a voxel's points.

    The last three axes are z, x, y. A voxel's edge is 1/64 of the workspace's side; the lowest layer is centred on the
    table.
    """
    edge = workspace.size / SIDE
    column = torch.floor(cloud.position[..., :2] / edge + SIDE / 2).long()
    layer = torch.floor(cloud.position[..., 2] / edge + 0.5).long()
    inside = cloud.valid & (layer >= 0) & (layer < HEIGHT)
    inside &= ((column >= 0) & (column < SIDE)).all(-1)
    batch = torch.arange(layer.shape[0], device=layer.device)[:, None]
    voxel = ((batch * HEIGHT + layer) * SIDE + column[..., 0]) * SIDE + column[..., 1]
    count = layer.shape[0] * HEIGHT * SIDE * SIDE
    voxel = torch.where(inside, voxel, count)  # an extra voxel collects the points outside the grid
    values = torch.cat([torch.ones_like(cloud.color[..., :1]), cloud.color], dim=-1).flatten(0, 1)
    sums = values.new_zeros(count + 1, VOXEL_CHANNELS).index_add_(0, voxel.flatten(), values)[:-1]
    grid = (sums / sums[:, :1].clamp(min=1)).view(layer.shape[0], HEIGHT, SIDE, SIDE, VOXEL_CHANNELS)
    return grid.permute(0, 4, 1, 2, 3).contiguous()
