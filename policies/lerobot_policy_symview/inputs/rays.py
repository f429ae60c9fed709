"""Rays of a camera's pixels, and their Plücker coordinates: a baseline that knows the camera without a view."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lerobot_policy_symview.symmetry.transforms import PlanarTransform
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views.torch_backend import ideal_pixels_batch


def pixel_rays(
    intrinsics: Tensor, calibrated: tuple[int, ...], size: tuple[int, ...], cameras: Sequence[Camera] | None = None
) -> Tensor:
    """Return the directions (B, h, w, 3) of the rays of an image's pixels in the camera's frame, float64, of depth 1.

    Args:
        intrinsics: (B, 9), K in pixels of the image at its calibrated size.
        calibrated: rows and columns of the image that K belongs to.
        size: rows h and columns w of the image after downscaling; a pixel has the ray of its centre.
        cameras: where cameras have a lens, the camera of each sample, or of all; its pose is not used.
    """
    k = intrinsics.double().view(-1, 3, 3)
    if cameras is None:
        v, u = (torch.arange(count, dtype=torch.float64, device=k.device) for count in size)
        v = v[:, None]
    else:
        height, width = map(int, size)  # a trace records sizes as tensors
        u, v = ideal_pixels_batch([camera.resized(height, width) for camera in cameras], k.device)
    v, u = ((axis + 0.5) * full / count - 0.5 for axis, full, count in zip((v, u), calibrated, size, strict=True))
    x = (u - k[:, 0, 2, None, None]) / k[:, 0, 0, None, None]
    y = (v - k[:, 1, 2, None, None]) / k[:, 1, 1, None, None]
    x, y = x.expand(-1, *size), y.expand(-1, *size)
    return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def plucker_rays(
    intrinsics: Tensor,
    world_from_cam: Tensor,
    calibrated: tuple[int, ...],
    size: tuple[int, ...],
    workspace: Workspace,
    cameras: Sequence[Camera] | None = None,
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
        cameras: as for `pixel_rays`.
    """
    pose = world_from_cam.double().view(-1, 4, 4)
    in_camera = pixel_rays(intrinsics, calibrated, size, cameras)
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
