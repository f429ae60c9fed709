"""Transformations of images: moving scenes about the workspace centre, scaling and cropping."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from lerobot_policy_symview.symmetry.representations import Motion

AUGMENTATIONS = {"d4": (4, True), "so2": (None, False), "o2": (None, True)}


def random_motion(turns: int | None, mirrors: bool, like: Tensor) -> Motion:
    """Draw one motion per sample of `like` (B, ...): by multiples of 360 degrees / `turns` or any, mirrored or not."""
    angle = torch.rand(len(like), device=like.device, dtype=like.dtype)
    angle = 2 * math.pi * (angle if turns is None else (angle * turns).floor() / turns)
    mirrored = torch.rand(len(like), device=like.device) < (0.5 if mirrors else 0.0)
    return Motion(angle, mirrored)


def move_images(images: Tensor, motion: Motion) -> Tensor:
    """Move the middle squares of images (B, C, H, W) as the scene moves; edges are extended.

    A quarter turn equals `torch.rot90(images, 1, (-2, -1))` and a mirror image `images.flip(-1)`, by DESIGN's pixel
    convention: rows grow with x, columns with y. It is computed in the images' precision under autocast too.

    Returns:
        (B, C, S, S), S the shorter of H and W.
    """
    images = crop(images, min(images.shape[-2:]))  # a turned oblong would be stretched to fit
    cos, sin, sign = torch.cos(motion.angle), torch.sin(motion.angle), motion.sign
    zero = torch.zeros_like(cos)
    # grid_sample asks where an output pixel (column, row) is read: at the inverse motion of its place (y, x)
    theta = torch.stack([torch.stack([sign * cos, -sign * sin, zero], -1), torch.stack([sin, cos, zero], -1)], dim=-2)
    with torch.autocast(images.device.type, enabled=False):  # its bfloat16 cannot tell a pixel from the next
        grid = functional.affine_grid(theta, list(images.shape), align_corners=False)
        return functional.grid_sample(images, grid, padding_mode="border", align_corners=False)


def scale_down(images: Tensor, size: int) -> Tensor:
    """Average images (B, C, H, W) over areas so that their shorter side has `size` pixels; smaller ones stay."""
    height, width = images.shape[-2:]
    shorter = min(height, width)
    if shorter <= size:
        return images
    return functional.interpolate(images, (height * size // shorter, width * size // shorter), mode="area")


def crop(images: Tensor, size: int, place: Tensor | None = None) -> Tensor:
    """Return size x size pixels of images (B, C, H, W).

    Args:
        images: at least that large.
        size: pixels.
        place: (B, 2) in [0, 1), which of the possible rows and columns each part begins at; by default the middle one.
    """
    batch, channels, height, width = images.shape
    if place is None:
        top, left = (height - size) // 2, (width - size) // 2
        return images[..., top : top + size, left : left + size]
    row, column = place.unbind(-1)
    corner = torch.stack([row * (height - size + 1), column * (width - size + 1)], dim=-1).long()
    rows, columns = (corner[..., None] + torch.arange(size, device=corner.device)).unbind(dim=1)
    index = torch.arange(batch, device=corner.device)[:, None, None, None]
    every = torch.arange(channels, device=corner.device)[:, None, None]
    return images[index, every, rows[:, None, :, None], columns[:, None, None]]
