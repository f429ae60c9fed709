"""Rays of a camera's pixels as image channels: Plücker coordinates, a baseline that knows the camera without a view."""

from __future__ import annotations

import torch
from torch import Tensor

from lerobot_policy_symview.symmetry.transforms import PlanarTransform
from lerobot_symview.geometry.workspace import Workspace


def plucker_rays(
    intrinsics: Tensor,
    world_from_cam: Tensor,
    calibrated: tuple[int, ...],
    size: tuple[int, ...],
    workspace: Workspace,
) -> Tensor:
    """Return the Plücker coordinates (B, 6, h, w) of the rays of an image's pixels, float32.

    The first three are the ray's unit direction in the world frame, the others its moment, camera position x direction,
    metres, about the workspace's centre on the table.

    Args:
        intrinsics: (B, 9), K in pixels of the image at its calibrated size.
        world_from_cam: (B, 16), pose of the camera, metres.
        calibrated: rows and columns of the image that K belongs to.
        size: rows h and columns w of the image after downscaling; a pixel has the ray of its centre.
        workspace: gives the origin of the moments.
    """
    k, pose = intrinsics.double().view(-1, 3, 3), world_from_cam.double().view(-1, 4, 4)
    v, u = (
        (torch.arange(count, dtype=torch.float64, device=k.device) + 0.5) * full / count - 0.5
        for count, full in zip(size, calibrated, strict=True)
    )
    x = ((u - k[:, :1, 2]) / k[:, :1, 0])[:, None].expand(-1, size[0], -1)
    y = ((v - k[:, 1:2, 2]) / k[:, 1:2, 1])[:, :, None].expand(-1, -1, size[1])
    in_camera = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    direction = torch.nn.functional.normalize(in_camera, dim=-1) @ pose[:, None, :3, :3].transpose(-1, -2)
    center = pose.new_tensor([*workspace.center, 0.0])
    moment = torch.linalg.cross((pose[:, :3, 3] - center)[:, None, None].expand_as(direction), direction)
    return torch.cat([direction, moment], dim=-1).permute(0, 3, 1, 2).float()


def transformed_rays(rays: Tensor, transform: PlanarTransform) -> Tensor:
    """Return the rays (B, 6, h, w) of the same pixels after a planar transform of the scene and its camera.

    Directions are vectors; moments are axial vectors, which a reflection negates besides.
    """
    dx, dy, dz, mx, my, mz = rays.unbind(dim=1)
    sign = transform.determinant[:, None, None]
    mx, my = transform.apply(sign * mx, sign * my)
    return torch.stack([*transform.apply(dx, dy), dz, mx, my, sign * mz], dim=1)
