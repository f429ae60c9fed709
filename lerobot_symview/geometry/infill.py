"""Infill of empty cells in reprojected images (paper A.5)."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

LOCAL_WINDOW = 5  # pixels, side of the neighbourhood that `local` infill averages
NOWHERE = 1 << 15  # rows; larger than any image
NEAR = 2  # columns that the vectorised search covers


def nearest_known(known: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Find the nearest known pixel of every pixel, by Euclidean distance (paper A.5).

    Args:
        known: (H, W) bool.

    Returns:
        (H, W) int32, row-major index of the nearest known pixel; a known pixel's own index. Ties go to the leftmost
        column, then to the uppermost row. -1 everywhere if no pixel is known.
    """
    row_of, nearest = np.empty(known.shape, dtype=np.int32), np.empty(known.shape, dtype=np.int32)
    if known.size:
        _find_nearest(known, row_of, nearest)
    return nearest


def fill_local(image: NDArray, known: NDArray[np.bool_]) -> NDArray:
    """Fill every unknown pixel of `image` (H, W) or (H, W, C) with the mean of the `known` (H, W) pixels around it.

    The window is 5 x 5 pixels; a pixel without known pixels in its window keeps its value (paper A.5). The dtype is
    kept; means of integers are rounded.
    """
    weight = _window_sum(known.astype(np.float32))
    reachable = ~known & (weight > 0.5)
    mask = known if image.ndim == 2 else known[..., None]
    mean = _window_sum(np.where(mask, image, 0).astype(np.float32))[reachable]
    mean /= weight[reachable] if image.ndim == 2 else weight[reachable, None]
    filled = image.copy()
    filled[reachable] = np.rint(mean) if np.issubdtype(image.dtype, np.integer) else mean
    return filled


def _window_sum(image: NDArray[np.float32]) -> NDArray[np.float32]:
    window = (LOCAL_WINDOW, LOCAL_WINDOW)
    return np.asarray(cv2.boxFilter(image, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT))


@njit(cache=True, nogil=True)
def _find_nearest(known, row_of, nearest):  # type: ignore[no-untyped-def]
    """Find the nearest known row of every pixel per column; then search each row sideways while that can be nearer.

    Loops over a whole row use 32-bit integers and no branches, so that the compiler vectorises them.
    """
    rows, columns = known.shape
    for c in range(columns):
        row_of[0, c] = 0 if known[0, c] else -NOWHERE
    for r in range(1, rows):
        for c in range(columns):
            row_of[r, c] = r if known[r, c] else row_of[r - 1, c]
    for r in range(rows - 2, -1, -1):
        here, row_below, row, twice = row_of[r], row_of[r + 1], np.int32(r), np.int32(2 * r)
        for c in range(columns):
            above, below = here[c], row_below[c]
            here[c] = below if (below > row) & (np.int32(below + above) < twice) else above
    if row_of[0].max() < 0:
        nearest[:] = -1
        return
    # Squared row distances, padded with values too large to be chosen, so that no step needs a bounds test.
    border = columns + NEAR
    far = np.full(columns + 2 * border, NOWHERE**2, dtype=np.int32)
    middle = far[border : border + columns]
    best, chosen = np.empty(columns, dtype=np.int32), np.empty(columns, dtype=np.int32)
    for r in range(rows):
        row_of_column = row_of[r]
        for c in range(columns):
            distance = np.int32(row_of_column[c] - r)
            distance = np.int32(distance * distance)
            middle[c], best[c], chosen[c] = distance, distance, 0
        for step in range(1, NEAR + 1):  # nearly all pixels have a known pixel this near
            lefts, rights = far[border - step : border - step + columns], far[border + step : border + step + columns]
            to_left, to_right, sideways = np.int32(-step), np.int32(step), np.int32(step * step)
            for c in range(columns):
                left, right = np.int32(lefts[c] + sideways), np.int32(rights[c] + sideways)
                nearer, offset = best[c], chosen[c]
                offset = to_left if left <= nearer else offset  # ties go to the leftmost
                nearer = left if left <= nearer else nearer
                chosen[c] = to_right if right < nearer else offset
                best[c] = right if right < nearer else nearer
        for c in range(columns):
            if best[c] > NEAR**2:
                chosen[c] = _search(far, border + c, columns, np.int64(best[c]), np.int64(chosen[c]))
        for c in range(columns):
            column = np.uint64(c + chosen[c])
            nearest[r, c] = row_of_column[column] * columns + c + chosen[c]


@njit(cache=True, nogil=True)
def _search(far, center, columns, best, offset):  # type: ignore[no-untyped-def]
    """Continue the sideways search of one pixel beyond `NEAR` columns."""
    step = NEAR + 1
    while step * step <= best and step < columns:
        left, right = far[center - step] + step * step, far[center + step] + step * step
        if left <= best:
            best, offset = left, -step
        if right < best:
            best, offset = right, step
        step += 1
    return offset
