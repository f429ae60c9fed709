"""RGBD reprojection: a depth image turned into an orthographic image from above (paper section 4.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lerobot_symview.camera import Array
from lerobot_symview.workspace import Workspace

INFILLS = ("nearest", "local", "none")
EMPTY = -1  # source index of a pixel that no point fell into
LOCAL_WINDOW = 5  # pixels, side of the neighbourhood that `local` infill averages


def zbuffer(points: Array, valid: NDArray[np.bool_], workspace: Workspace, pixels: int) -> NDArray[np.int64]:
    """Bin points into a top-down grid and keep the highest of each pixel (paper Eq. 5-6).

    Args:
        points: (N, 3) world coordinates, metres.
        valid: (N,) which points take part; their coordinates must be finite.
        workspace: what the grid covers.
        pixels: side of the grid.

    Returns:
        (pixels, pixels) int64: index into `points` of the highest point, ties to the lowest index; `EMPTY` where none.
    """
    source = np.flatnonzero(valid)
    rows, columns = np.floor(workspace.pixel_from_xy(points[source, :2], pixels) + 0.5).T
    inside = (rows >= 0) & (rows < pixels) & (columns >= 0) & (columns < pixels)
    source, rows, columns = source[inside], rows[inside].astype(np.int64), columns[inside].astype(np.int64)
    # One unsigned key per point orders by height, then by earliest source: the maximum per cell is the answer, exactly.
    key = (ordered_bits(points[source, 2]) << np.uint64(32)) | (np.uint64(0xFFFFFFFF) - source.astype(np.uint64))
    best = np.zeros(pixels * pixels, dtype=np.uint64)
    np.maximum.at(best, rows * pixels + columns, key)
    winner = (np.uint64(0xFFFFFFFF) - (best & np.uint64(0xFFFFFFFF))).astype(np.int64)
    return np.where(best > 0, winner, EMPTY).reshape(pixels, pixels)


def ordered_bits(values: Array) -> NDArray[np.uint64]:
    """Map numbers, rounded to float32, to unsigned integers below 2^32 that compare the same way; none maps to 0."""
    bits = (values.astype(np.float32) + np.float32(0)).view(np.uint32)  # adding 0 turns -0 into +0
    negative = bits >> np.uint32(31) == 1
    return np.where(negative, ~bits, bits | np.uint32(1 << 31)).astype(np.uint64)


def fill_nearest(source: NDArray[np.int64]) -> NDArray[np.int64]:
    """Give every `EMPTY` pixel of a source map (H, W) the source of the nearest (Euclidean) filled one (paper A.5)."""
    empty = source == EMPTY
    if empty.all() or not empty.any():
        return source
    rows, columns = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    return source[rows, columns]


def fill_local(image: NDArray, known: NDArray[np.bool_]) -> NDArray:
    """Give every pixel of `image` (H, W) or (H, W, C) that is not `known` (H, W) the mean of the known ones nearby.

    Nearby is a window of 5 x 5 pixels; a pixel without a known one in it keeps its value (paper A.5).
    """
    planes = np.where(known[..., None], image.reshape(*known.shape, -1), 0).astype(np.float64)
    weight = ndimage.uniform_filter(known.astype(np.float64), LOCAL_WINDOW, mode="constant")
    total = ndimage.uniform_filter(planes, (LOCAL_WINDOW, LOCAL_WINDOW, 1), mode="constant")
    reachable = ~known & (weight > 0.5 / LOCAL_WINDOW**2)
    mean = total[reachable] / weight[reachable, None]
    filled = image.reshape(*known.shape, -1).copy()
    filled[reachable] = np.rint(mean) if image.dtype == np.uint8 else mean
    return filled.reshape(image.shape)
