"""Voxel grids of the working volume: occupancy and colour (paper A.4: 64 x 64 x 32 voxels of 0.625 cm)."""

from __future__ import annotations

import torch
from torch import Tensor

from lerobot_policy_symview.inputs.clouds import Cloud
from lerobot_symview.geometry.gripper import GripperShape, gripper_coverage, ramp
from lerobot_symview.geometry.workspace import Workspace

SIDE = 64
HEIGHT = 32
VOXEL_CHANNELS = 4


def gripper_voxels(pose: Tensor, workspace: Workspace) -> Tensor:
    """Return which part of each voxel the gripper's fingers cover: (B, 1, 32, 64, 64), of the dtype of the poses.

    Args:
        pose: (B, 5), as for `gripper_image`; a finger is a cube around the gripper's height, or at the top of the grid.
        workspace: the working volume.
    """
    edge, shape = workspace.size / SIDE, GripperShape()
    heights = edge * torch.arange(HEIGHT, dtype=pose.dtype, device=pose.device)
    layers = ramp(torch, (heights - pose[:, 2:3].clamp(max=HEIGHT * edge)).abs(), shape, edge)
    coverage: Tensor = gripper_coverage(pose, workspace, SIDE, shape)
    return (layers[:, :, None, None] * coverage[:, None])[:, None]


def voxelize(cloud: Cloud, workspace: Workspace, gripper: Tensor | None = None) -> Tensor:
    """Return voxel grids (B, 4, 32, 64, 64) float32: occupancy (0 or 1) and the mean RGB of a voxel's points.

    The last three axes are z, x, y. A voxel's edge is 1/64 of the workspace's side; the lowest layer is centred on the
    table. With the gripper's poses (B, 5), a fifth channel is `gripper_voxels`.
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
    grid = grid.permute(0, 4, 1, 2, 3)
    if gripper is not None:
        grid = torch.cat([grid, gripper_voxels(gripper, workspace).to(grid.dtype)], dim=1)
    return grid.contiguous()
