"""Occupancy and colour of the working volume on a grid (paper A.4: 64 x 64 x 32 voxels of 0.625 cm)."""

from __future__ import annotations

import torch
from torch import Tensor

from lerobot_policy_symview.inputs.clouds import Cloud
from lerobot_symview.geometry.workspace import Workspace

SIDE = 64
HEIGHT = 32
VOXEL_CHANNELS = 4


def voxelize(cloud: Cloud, workspace: Workspace) -> Tensor:
    """Return (B, 4, 32, 64, 64) float32: whether a voxel holds a point, and its points' mean colour; z, x, y last.

    Voxels are cubes of 1/64 of the workspace's side; the lowest layer is centred on the table.
    """
    edge = workspace.size / SIDE
    column = torch.floor(cloud.position[..., :2] / edge + SIDE / 2).long()
    layer = torch.floor(cloud.position[..., 2] / edge + 0.5).long()
    inside = cloud.valid & (layer >= 0) & (layer < HEIGHT)
    inside &= ((column >= 0) & (column < SIDE)).all(-1)
    batch = torch.arange(len(layer), device=layer.device)[:, None]
    voxel = ((batch * HEIGHT + layer) * SIDE + column[..., 0]) * SIDE + column[..., 1]
    count = len(layer) * HEIGHT * SIDE * SIDE
    voxel = torch.where(inside, voxel, count)  # one more voxel takes what lies outside
    values = torch.cat([torch.ones_like(cloud.color[..., :1]), cloud.color], dim=-1).flatten(0, 1)
    sums = values.new_zeros(count + 1, VOXEL_CHANNELS).index_add_(0, voxel.flatten(), values)[:-1]
    grid = (sums / sums[:, :1].clamp(min=1)).view(len(layer), HEIGHT, SIDE, SIDE, VOXEL_CHANNELS)
    return grid.permute(0, 4, 1, 2, 3).contiguous()
