"""Random planar transforms of scenes, and the images they transform: rotated, scaled and cropped."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from lerobot_policy_symview.symmetry.transforms import PlanarTransform

AUGMENTATIONS = {"d4": (4, True), "so2": (None, False), "o2": (None, True)}
"""Name -> number of rotations (None: any angle) and whether reflections belong to it."""


def random_transform(rotations: int | None, reflections: bool, like: Tensor) -> PlanarTransform:
    """Draw one transform per sample of `like` (B, ...).

    Args:
        rotations: angles are multiples of 360 degrees / `rotations`; None draws any angle.
        reflections: reflect half of the samples.
        like: says how many samples there are, the device and the dtype.
    """
    angle = torch.rand(len(like), device=like.device, dtype=like.dtype)
    angle = 2 * math.pi * (angle if rotations is None else (angle * rotations).floor() / rotations)
    reflected = torch.rand(len(like), device=like.device) < (0.5 if reflections else 0.0)
    return PlanarTransform(angle, reflected)


def transform_images(images: Tensor, transform: PlanarTransform) -> Tensor:
    """Transform the central squares of top-down images (B, C, H, W) with the scene; borders are repeated outwards.

    A rotation by 90 degrees equals `torch.rot90(images, 1, (-2, -1))` and a reflection `images.flip(-1)`: rows grow
    with x, columns with y. It is computed in the images' precision under autocast too.

    Returns:
        (B, C, S, S), S the shorter of H and W.
    """
    images = crop(images, min(images.shape[-2:]))  # a rotated oblong would be stretched to fit
    cos, sin, det = torch.cos(transform.angle), torch.sin(transform.angle), transform.determinant
    zero = torch.zeros_like(cos)
    # grid_sample reads an output pixel (column, row) at the inverse transform of its (y, x)
    theta = torch.stack([torch.stack([det * cos, -det * sin, zero], -1), torch.stack([sin, cos, zero], -1)], dim=-2)
    with torch.autocast(images.device.type, enabled=False):  # its bfloat16 cannot resolve a pixel
        grid = functional.affine_grid(theta, list(images.shape), align_corners=False)
        return functional.grid_sample(images, grid, padding_mode="border", align_corners=False)


def scale_down(images: Tensor, size: int) -> Tensor:
    """Downscale images (B, C, H, W) by area averaging to a shorter side of `size` pixels; smaller images are kept."""
    height, width = images.shape[-2:]
    shorter = min(height, width)
    if shorter <= size:
        return images
    return functional.interpolate(images, (height * size // shorter, width * size // shorter), mode="area")


def crop(images: Tensor, size: int, offset: Tensor | None = None) -> Tensor:
    """Crop images (B, C, H, W) to size x size pixels.

    Args:
        images: at least `size` pixels high and wide.
        size: rows and columns of the crop.
        offset: (B, 2) in [0, 1), the crop offset of each image, row and column, relative to the largest; by default
            the centre crop.
    """
    batch, _, height, width = images.shape
    if offset is None:
        top, left = (height - size) // 2, (width - size) // 2
        return images[..., top : top + size, left : left + size]
    row, column = offset.unbind(-1)
    corner = torch.stack([row * (height - size + 1), column * (width - size + 1)], dim=-1).long()
    windows = images.unfold(2, size, 1).unfold(3, size, 1)  # (B, C, row, column, size, size), all crops, not copied
    return windows[torch.arange(batch, device=corner.device), :, corner[:, 0], corner[:, 1]]
