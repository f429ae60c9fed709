"""What to show where no point fell (paper A.5)."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

LOCAL_WINDOW = 5  # pixels, side of the neighbourhood that `local` infill averages
NOWHERE = 1 << 15  # rows away: farther than any image is large


def nearest_known(known: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Find the nearest known pixel of every pixel, by Euclidean distance.

    Args:
        known: (H, W) bool.

    Returns:
        (H, W) int32, row-major index of the nearest known pixel, which for a known one is itself. Of equally near ones
        the one in the leftmost column, and in that the uppermost. -1 everywhere if none is known.
    """
    nearest = np.full(known.shape, -1, dtype=np.int32)
    if known.any():
        _find_nearest(known, np.empty(known.shape, dtype=np.int32), nearest)
    return nearest


def fill_local(image: NDArray, known: NDArray[np.bool_]) -> NDArray:
    """Give every pixel of `image` (H, W) or (H, W, C) that is not `known` (H, W) the mean of the known ones nearby.

    Nearby is a window of 5 x 5 pixels; a pixel without a known one in it keeps its value (paper A.5). The dtype is
    kept, means of integers are rounded.
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
    """Find, per column, the nearest known row of every pixel; then search each row outwards while it can get nearer."""
    rows, columns = known.shape
    for c in range(columns):
        row_of[0, c] = 0 if known[0, c] else -NOWHERE
    for r in range(1, rows):
        for c in range(columns):
            row_of[r, c] = r if known[r, c] else row_of[r - 1, c]
    for r in range(rows - 2, -1, -1):
        for c in range(columns):
            if row_of[r + 1, c] - r < r - row_of[r, c] and row_of[r + 1, c] > r:
                row_of[r, c] = row_of[r + 1, c]
    for r in range(rows):
        for c in range(columns):
            if known[r, c]:
                nearest[r, c] = r * columns + c
                continue
            best_column = c
            best = (row_of[r, c] - r) ** 2
            step = 1
            while step * step <= best and (step <= c or c + step < columns):
                if step <= c:
                    distance = (row_of[r, c - step] - r) ** 2 + step * step
                    if distance <= best:  # of equals the leftmost
                        best, best_column = distance, c - step
                if c + step < columns:
                    distance = (row_of[r, c + step] - r) ** 2 + step * step
                    if distance < best:
                        best, best_column = distance, c + step
                step += 1
            nearest[r, c] = row_of[r, best_column] * columns + best_column
