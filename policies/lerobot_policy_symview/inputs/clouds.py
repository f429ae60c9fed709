"""Coloured point clouds of the workspace from batches of RGBD images, computed on the images' device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from lerobot_policy_symview.inputs.rays import pixel_rays
from lerobot_policy_symview.symmetry.transforms import PlanarTransform
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.gripper import GripperShape
from lerobot_symview.geometry.workspace import Workspace

POINTS = 1024  # points per scene that the point-cloud encoder gets


@dataclass(frozen=True)
class Cloud:
    """Point clouds of B scenes, one point for each of the P pixels of an image.

    Args:
        position: (B, P, 3) float64 metres; x and y relative to the workspace centre, z above the table.
        color: (B, P, 3) RGB in [0, 1].
        valid: (B, P) bool, whether the pixel's depth is valid and its point lies in the working volume.
    """

    position: Tensor
    color: Tensor
    valid: Tensor

    def transformed(self, transform: PlanarTransform) -> Cloud:
        """Return the cloud of the transformed scenes, one transform per scene."""
        x, y = transform.apply(self.position[..., 0], self.position[..., 1])
        return replace(self, position=torch.stack([x, y, self.position[..., 2]], dim=-1))

    def shifted(self, shift: Tensor) -> Cloud:
        """Return the cloud of the scenes moved by (B, 2) metres along x and y."""
        x, y = (self.position[..., :2] + shift[:, None]).unbind(-1)
        return replace(self, position=torch.stack([x, y, self.position[..., 2]], dim=-1))

    def sample(self, count: int, shuffle: bool, gripper: Tensor | None = None) -> Tensor:
        """Sample `count` valid points per scene: (B, count, 6) float32, x, y, z in metres and RGB.

        Without `shuffle` the sampling order is fixed for each image size. A scene with fewer valid points repeats them;
        a scene without any gives zeros. With the gripper's poses (B, 5), the second and third point are
        `gripper_points`, which have no colour, and a seventh channel is 1 for them and 0 for the others.
        """
        if gripper is not None:  # farthest point sampling begins at the first point, and neighbours are the first ones
            fingers = gripper_points(gripper).to(self.color.dtype)
            points = functional.pad(self.sample(count - fingers.shape[1], shuffle), (0, 1))
            drawn = functional.pad(functional.pad(fingers, (0, 3)), (0, 1), value=1.0)
            return torch.cat([points[:, :1], drawn, points[:, 1:]], dim=1)
        if shuffle:
            rank = torch.rand(self.valid.shape, device=self.valid.device)
        else:
            rank = fixed_ranks(self.valid.shape[1]).to(self.valid.device)
        distinct = min(count, self.valid.shape[1])
        order = torch.where(self.valid, rank, 2.0).topk(distinct, dim=1, largest=False).indices
        available = self.valid.sum(dim=1, keepdim=True).clamp(min=1)
        chosen = order.gather(1, torch.arange(count, device=order.device)[None] % available)
        points = torch.cat([self.position.to(self.color.dtype), self.color], dim=-1)
        points = points.gather(1, chosen[..., None].expand(-1, -1, points.shape[-1]))
        return points * self.valid.any(dim=1)[:, None, None]


def gripper_points(pose: Tensor) -> Tensor:
    """Return the centres of the gripper's two fingers: (B, 2, 3) metres, x and y relative to the workspace centre.

    More points would have distances that are equal by symmetry, and farthest point sampling would choose among them by
    rounding.

    Args:
        pose: (B, 5), as for `gripper_image`.
    """
    x, y, z, yaw, aperture = pose.unbind(-1)
    reach = GripperShape().reach(aperture)
    along = torch.stack([reach * torch.cos(yaw), reach * torch.sin(yaw), torch.zeros_like(z)], dim=-1)
    center = torch.stack([x, y, z], dim=-1)
    return torch.stack([center - along, center + along], dim=1)


@torch.compiler.assume_constant_result
def fixed_ranks(count: int) -> Tensor:
    """Return `count` distinct ranks in [0, 1), always the same; (count,) float32.

    They are drawn by NumPy, so that an exported or traced policy has them as a constant. A trace would record a random
    operation of torch without its generator, and sample other points in every call.
    """
    return torch.from_numpy(np.random.default_rng(0).random(count, dtype=np.float32))


def cloud_from_depth(
    rgb: Tensor,
    depth: Tensor,
    intrinsics: Tensor,
    world_from_cam: Tensor,
    workspace: Workspace,
    ceiling: Tensor,
    cameras: Sequence[Camera] | None = None,
) -> Cloud:
    """Unproject RGBD images (paper Eq. 2 to 4); points in the working volume and below the ceiling are valid.

    Args:
        rgb: (B, 3, H, W) RGB in [0, 1].
        depth: (B, 1, H, W) metres along the optical axis; 0 and non-finite values are invalid.
        intrinsics: (B, 9) row-major K, pixels.
        world_from_cam: (B, 16) row-major camera poses, translation in metres.
        workspace: the working volume.
        ceiling: (B,) metres above the table; points above it are invalid, which removes the arm, as in reprojection.
        cameras: where cameras have a lens, the camera of each sample, or of all.
    """
    batch, _, *size = depth.shape
    distance, pose = depth[:, 0].double(), world_from_cam.double().view(batch, 4, 4)
    in_camera = pixel_rays(intrinsics, tuple(size), tuple(size), cameras)
    rays = in_camera.flatten(1, 2) @ pose[:, :3, :3].transpose(1, 2)
    world = rays * distance.view(batch, -1, 1) + pose[:, None, :3, 3]
    x, y, z = world.unbind(-1)
    position = torch.stack([x - workspace.center[0], y - workspace.center[1], z], dim=-1)
    half = workspace.size / 2
    valid = (distance > 0) & torch.isfinite(distance)
    valid = valid.flatten(1) & (position[..., :2].abs() < half).all(-1)
    valid &= position[..., 2] < ceiling.double().clamp(max=workspace.height_limit)[:, None]
    # invalid points are set to the centre, so that no infinity or NaN reaches a network
    position = torch.where(valid[..., None], position, 0.0)
    return Cloud(position, rgb.flatten(2).transpose(1, 2), valid)
