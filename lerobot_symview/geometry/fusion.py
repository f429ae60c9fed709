"""Several cameras in one top-down image: the highest surface of each cell, by the camera that shows it best."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.homography import pixel_density
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.geometry.zbuffer import EMPTY, ZBuffer, empty_buffer, zbuffer_from_depth

SAME_SURFACE = 0.01  # metres: points of a cell that are no farther apart may belong to one surface
DISAGREEMENT_PIXELS = 96  # rows and columns of the buffers that are compared


def fuse_buffers(buffers: Sequence[ZBuffer], cameras: Sequence[Camera], workspace: Workspace) -> ZBuffer:
    """Return one z-buffer of several cameras.

    Cameras are added in order. One replaces what a cell shows if its point is more than 1 cm higher, or if it is within
    1 cm, and thus may be of the same surface, and the camera has a greater `pixel_density` there.

    Args:
        buffers: (P, P) of each camera's own depth image.
        cameras: the cameras.
        workspace: the square on the table that the buffers cover.

    Returns:
        A buffer whose source is the row-major index of the pixel, counted over all images in order.
    """
    pixels = len(buffers[0].height)
    fused = empty_buffer(pixels)
    density, first = np.zeros((pixels, pixels), np.float32), 0
    for buffer, camera in zip(buffers, cameras, strict=True):
        _add(*buffer, pixel_density(camera, workspace, pixels), first, *fused, density)
        first += camera.height * camera.width
    return fused


def disagreement(
    depths: Sequence[NDArray[np.floating]], cameras: Sequence[Camera], workspace: Workspace, ceiling: float = np.inf
) -> float:
    """Return in which share of the cells two cameras measure different heights, for the two that differ most.

    Cells are compared where both cameras see something, at least one of them above the table. They differ if the height
    of each is more than 1 cm outside of what the other measures in the cell and its eight neighbours. In our
    simulator's tasks, two cameras with right calibrations differ in up to 0.14 of the cells, at edges and at the arm;
    with a position that is wrong by 3 cm, in more than half at the median, but in less than a third for a quarter of
    the directions: a small share does not prove a calibration.

    Args:
        depths: (H, W) float each, metres along the optical axis; 0, negative, infinite and NaN are ignored.
        cameras: calibrated camera of each depth image.
        workspace: the square on the table.
        ceiling: metres above the table; higher points, such as those of the arm, are ignored.

    Returns:
        From 0 to 1; 0 where no cells can be compared.
    """
    buffers = [
        zbuffer_from_depth(depth, camera, workspace, DISAGREEMENT_PIXELS, ceiling)
        for depth, camera in zip(depths, cameras, strict=True)
    ]
    shares = [0.0]
    for index, first in enumerate(buffers):
        for second in buffers[index + 1 :]:
            both = (first.source != EMPTY) & (second.source != EMPTY)
            compared = both & (np.maximum(first.height, second.height) > SAME_SURFACE)
            differs = _outside(first, second) & _outside(second, first)
            shares.append(float(differs[compared].mean()) if compared.any() else 0.0)
    return max(shares)


def _outside(buffer: ZBuffer, other: ZBuffer) -> NDArray[np.bool_]:
    """Return where a buffer's height is more than 1 cm outside of the other's heights around."""
    known = other.source != EMPTY
    low, high = (np.pad(np.where(known, other.height, value), 1, constant_values=value) for value in (np.inf, -np.inf))
    lowest = np.lib.stride_tricks.sliding_window_view(low, (3, 3)).min(axis=(2, 3))
    highest = np.lib.stride_tricks.sliding_window_view(high, (3, 3)).max(axis=(2, 3))
    return (buffer.height < lowest - SAME_SURFACE) | (buffer.height > highest + SAME_SURFACE)


@njit(cache=True, nogil=True)
def _add(heights, sources, densities, first, height, source, density):  # type: ignore[no-untyped-def]
    heights, sources, densities = heights.ravel(), sources.ravel(), densities.ravel()
    height, source, density = height.ravel(), source.ravel(), density.ravel()
    for cell in range(len(heights)):
        if sources[cell] >= 0:
            rise = heights[cell] - height[cell]
            is_better = rise >= -SAME_SURFACE and densities[cell] > density[cell]
            if source[cell] < 0 or rise > SAME_SURFACE or is_better:
                height[cell], density[cell] = heights[cell], densities[cell]
                source[cell] = first + sources[cell]
