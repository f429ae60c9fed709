"""What is wrong with the intrinsics, the pose or the lens of a camera."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.geometry.lens import Lens

Array = NDArray[np.float64]

BORDER_SAMPLES = 33  # per side of the image, where a lens is checked


def calibration_problems(
    intrinsics: Array, pose: Array, size: tuple[int, int] | None, pose_name: str = "world_from_cam"
) -> list[str]:
    """Return all problems of the matrices of a camera; empty if they are valid.

    Args:
        intrinsics: (3, 3), K in pixels.
        pose: (4, 4), rigid.
        size: rows and columns of the image; None if they are unknown.
        pose_name: name of the pose in the messages.
    """
    if intrinsics.shape != (3, 3):
        return [f"intrinsics must have shape (3, 3), got {intrinsics.shape}"]
    if pose.shape != (4, 4):
        return [f"{pose_name} must have shape (4, 4), got {pose.shape}"]
    if not (np.isfinite(intrinsics).all() and np.isfinite(pose).all()):
        return ["matrices must be finite"]
    problems = []
    (fx, skew, cx), (row_1, fy, cy), last = intrinsics
    if fx <= 0 or fy <= 0:
        problems.append(f"focal lengths must be positive, got fx={fx:g}, fy={fy:g}")
    if skew != 0 or row_1 != 0 or not np.array_equal(last, [0, 0, 1]):
        problems.append("intrinsics must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    if size is not None and not (0 <= cx <= size[1] - 1 and 0 <= cy <= size[0] - 1):
        problems.append(f"principal point ({cx:g}, {cy:g}) lies outside the {size[1]} x {size[0]} image")
    rotation = pose[:3, :3]
    deviation = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if deviation > 1e-4:
        problems.append(f"rotation is not orthonormal (largest deviation {deviation:.2g})")
    elif np.linalg.det(rotation) < 0:
        problems.append("rotation is a reflection (determinant -1): the axes are left-handed")
    if not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6):
        problems.append(f"last row of {pose_name} must be 0 0 0 1, got {pose[3]}")
    return problems


@lru_cache(maxsize=256)
def lens_problems(lens: Lens, fx: float, fy: float, cx: float, cy: float, height: int, width: int) -> list[str]:
    """Return what is wrong with a lens that does not show one ray in each pixel of an image."""
    u, v = (np.linspace(-0.5, side - 0.5, BORDER_SAMPLES) for side in (width, height))
    low, high = np.full_like(u, -0.5), np.full_like(u, -0.5)
    border = np.concatenate(
        [np.column_stack(side) for side in ((u, low), (u, high + height), (low, v), (high + width, v))]
    )
    if not np.isnan(lens.undistort((border - [cx, cy]) / [fx, fy])).any():
        return []
    return [
        f"the {lens.model} lens shows rays only up to {lens.reach * min(fx, fy):.0f} pixels from the principal point, "
        f"beyond which it folds back, and the {width} x {height} image is larger: check the model, the order of its "
        "coefficients and the image size that they belong to, or crop the image"
    ]
