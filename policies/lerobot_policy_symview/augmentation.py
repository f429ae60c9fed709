"""Image transformations of training: turning about the centre and cropping."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def turn_images(images: Tensor, angle: Tensor) -> Tensor:
    """Turn top-down images (B, C, H, H) as the scene turns by `angle` (B,) radians about z; edges are extended.

    A quarter turn equals `torch.rot90(images, 1, (-2, -1))`, by DESIGN's pixel convention: rows grow with x, columns
    with y.
    """
    cos, sin = torch.cos(angle), torch.sin(angle)
    zero = torch.zeros_like(cos)
    theta = torch.stack([torch.stack([cos, -sin, zero], -1), torch.stack([sin, cos, zero], -1)], dim=-2)
    grid = functional.affine_grid(theta, list(images.shape), align_corners=False)
    return functional.grid_sample(images, grid, padding_mode="border", align_corners=False)


def center_crop(images: Tensor, size: int) -> Tensor:
    """Return the middle size x size pixels of images (B, C, H, W)."""
    top, left = (images.shape[-2] - size) // 2, (images.shape[-1] - size) // 2
    return images[..., top : top + size, left : left + size]


def random_crop(images: Tensor, size: int) -> Tensor:
    """Return size x size pixels at a random place of each image of (B, C, H, W)."""
    batch, channels, height, width = images.shape
    device = images.device
    rows = torch.randint(height - size + 1, (batch, 1), device=device) + torch.arange(size, device=device)
    columns = torch.randint(width - size + 1, (batch, 1), device=device) + torch.arange(size, device=device)
    index = torch.arange(batch, device=device)[:, None, None, None]
    return images[
        index, torch.arange(channels, device=device)[:, None, None], rows[:, None, :, None], columns[:, None, None]
    ]
