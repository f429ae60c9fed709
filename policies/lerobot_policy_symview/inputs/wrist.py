"""Images of a camera on the gripper: turning the scene leaves them, reflecting it exchanges left and right."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from lerobot_policy_symview.symmetry.augmentation import crop
from lerobot_policy_symview.symmetry.transforms import PlanarTransform


def wrist_input(
    images: Tensor,
    size: int,
    crop_size: int,
    transform: PlanarTransform | None = None,
    crop_offset: Tensor | None = None,
) -> Tensor:
    """Return images (B, 3, crop_size, crop_size) of transformed scenes.

    Args:
        images: (B, 3, H, W), colour in [0, 1]; all of it is kept, whatever its aspect ratio.
        size: rows and columns to which images are resized before they are cropped.
        crop_size: rows and columns of the crop. The difference to `size` is even, so that the centre crop of a
            reflected image is that of the image, reflected.
        transform: planar transform of each scene; by default none.
        crop_offset: (B, 2) in [0, 1), row and column relative to the largest offset; by default the centre crop.
    """
    resized = functional.interpolate(images, (size, size), mode="bilinear", antialias=True)
    if transform is not None:
        resized = torch.where(transform.reflected[:, None, None, None], resized.flip(-1), resized)
    return crop(resized, crop_size, crop_offset)
