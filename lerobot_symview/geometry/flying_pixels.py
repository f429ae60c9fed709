"""Flying pixels: depth measured at the edge of an object, between the object and what is behind it."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


def without_flying_pixels(depth: NDArray[np.floating], limit: float) -> NDArray[np.floating]:
    """Return depth with 0 where a pixel lies between two surfaces.

    Such a pixel is farther than one of its neighbours in a row or column and nearer than the opposite one, both by
    more than a limit. Pixels of the surfaces themselves, with such a step on one side only, stay.

    Args:
        depth: (H, W) float, metres; invalid pixels, 0, negative or non-finite, are neighbours of none.
        limit: metres. A plane that the camera sees at a low angle has steps of its own, depth² / (focal length x
            height of the camera) from row to row.
    """
    result = depth.copy()
    _drop(depth, limit, result)
    return result


@njit(cache=True, nogil=True)
def _drop(depth, limit, result):  # type: ignore[no-untyped-def]
    rows, columns = depth.shape
    for v in range(rows):
        for u in range(columns):
            here = np.float64(depth[v, u])
            in_row = 0 < u < columns - 1 and _is_between(depth[v, u - 1], here, depth[v, u + 1], limit)
            if in_row or (0 < v < rows - 1 and _is_between(depth[v - 1, u], here, depth[v + 1, u], limit)):
                result[v, u] = 0


@njit(cache=True, nogil=True)
def _is_between(before, here, after, limit):  # type: ignore[no-untyped-def]
    if not (before > 0 and after > 0 and before < np.inf and after < np.inf):
        return False
    before, after = np.float64(before), np.float64(after)
    return (here - before > limit and after - here > limit) or (before - here > limit and here - after > limit)
