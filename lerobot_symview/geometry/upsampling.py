"""Upsampling of depth images, so that neighbouring points leave no gaps in the top-down image."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Array

# Larger relative depth steps between neighbouring pixels are edges; a plane at 15 degrees to the view stays below.
MAX_STEP = 0.04


def enlarge_depth(depth: NDArray[np.floating], factor: int) -> NDArray[np.float32]:
    """Upsample a depth image; interpolate within surfaces, not across depth edges.

    The inverse of depth is affine over a plane's image, so its bilinear interpolation is exact for planes, and through
    a lens as good as exact, since neighbouring pixels share its distortion. Across an
    edge, where neighbours differ by more than 4 %, and beside invalid pixels, the nearest pixel's depth is repeated.

    Args:
        depth: (H, W) float, metres along the optical axis; 0, negative, infinite and NaN are invalid.
        factor: upsampling factor of rows and columns, at least 1.

    Returns:
        (factor * H, factor * W) float32, metres, 0 where invalid; for the camera `Camera.resized` to this size.
    """
    rows, columns = depth.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where((depth > 0) & (depth < np.inf), 1.0 / depth.astype(np.float64), 0.0)
    enlarged = np.empty((factor * rows, factor * columns), dtype=np.float32)
    _interpolate(inverse, _neighbours(rows, factor), _neighbours(columns, factor), factor, enlarged)
    return enlarged


@lru_cache(maxsize=64)
def _neighbours(count: int, factor: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Indices of the pixels before and after each new pixel along an axis, and its interpolation weight (0 to 1)."""
    position = np.clip((np.arange(factor * count) + 0.5) / factor - 0.5, 0, count - 1)
    before = np.floor(position).astype(np.int64)
    return before, np.minimum(before + 1, count - 1), position - before


@njit(cache=True, nogil=True)
def _interpolate(inverse, between_rows, between_columns, factor, enlarged):  # type: ignore[no-untyped-def]
    tops, bottoms, downs = between_rows
    lefts, rights, acrosses = between_columns
    for i in range(enlarged.shape[0]):
        for j in range(enlarged.shape[1]):
            a, b = inverse[tops[i], lefts[j]], inverse[tops[i], rights[j]]
            c, d = inverse[bottoms[i], lefts[j]], inverse[bottoms[i], rights[j]]
            largest, smallest = max(max(a, b), max(c, d)), min(min(a, b), min(c, d))
            if smallest > 0.0 and largest <= (1.0 + MAX_STEP) * smallest:
                upper = a + acrosses[j] * (b - a)
                lower = c + acrosses[j] * (d - c)
                value = upper + downs[i] * (lower - upper)
            else:
                value = inverse[i // factor, j // factor]
            enlarged[i, j] = 1.0 / value if value > 0.0 else 0.0
