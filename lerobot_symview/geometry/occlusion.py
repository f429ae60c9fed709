"""Infill that knows what hides an empty cell of a reprojected image.

The nearest point to an empty cell may be the edge of an object, at a height at which the camera looks through the cell:
nothing is there, or the camera would have measured it. Such a cell lies in the object's shadow, and shows what is
behind the object.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Array, Camera, Optics, from_ideal
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.geometry.zbuffer import ZBuffer

SEE_THROUGH = 0.01  # metres between a point and the surface behind it; above the noise of depth cameras


def without_smear(
    shown: NDArray[np.int32],
    buffer: ZBuffer,
    depth: NDArray[np.floating],
    camera: Camera,
    workspace: Workspace,
) -> NDArray[np.int32]:
    """Replace the cells that empty pixels show and that contradict the depth image.

    An empty pixel contradicts it if the camera looks through the point at the pixel's place and the shown cell's
    height, unless that is the table's. It then shows the first cell behind it, seen from the camera, that contradicts
    nothing; if there is none, the first in front of it; else it is kept unchanged. Several cameras are treated one
    after the other; a later one may choose a cell that contradicts an earlier one.

    Args:
        shown: (P, P) int32, row-major index of the cell that each pixel shows, such as the nearest known; -1 for none.
        buffer: (P, P) heights and sources.
        depth: (H, W) float, metres along the optical axis; 0, negative and non-finite pixels contradict nothing, nor
            does what a lens shows outside of the pinhole image of the same K and size.
        camera: its calibration.
        workspace: the square on the table that the image shows.

    Returns:
        (P, P) int32.
    """
    pixels = len(shown)
    position = workspace.pixel_from_xy(camera.position[None, :2], pixels)[0] + 0.5
    chosen = shown.copy()
    _replace(chosen, *buffer, pinhole_depth(depth, camera), image_from_grid(camera, workspace, pixels), position)
    return chosen


def pinhole_depth(depth: NDArray[np.floating], camera: Camera) -> NDArray[np.floating]:
    """Return the depth image of a camera's ideal pixels: of the pinhole camera with the same K and size."""
    if camera.lens is None:
        return np.ascontiguousarray(depth)
    return np.asarray(cv2.remap(np.asarray(depth, np.float32), *_maps(camera.optics), cv2.INTER_NEAREST))


@lru_cache(maxsize=64)
def image_from_grid(camera: Camera, workspace: Workspace, pixels: int) -> Array:
    """Return (3, 4): (row, column, height, 1), rows and columns from the grid's edge, to depth times (u, v, 1)."""
    cell = workspace.size / pixels
    world_from_grid = np.diag([cell, cell, 1.0, 1.0])
    world_from_grid[:2, 3] = np.asarray(workspace.center) - workspace.size / 2
    matrix: Array = camera.intrinsics @ (camera.cam_from_world @ world_from_grid)[:3]
    return matrix


@lru_cache(maxsize=8)
def _maps(optics: Optics) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the pixels, u and v, of the image of a lens that show the rays of ideal pixels."""
    lens, fx, fy, cx, cy, height, width = optics
    camera = Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.eye(4), height, width, lens)
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    mapped = np.nan_to_num(from_ideal(np.stack([u, v], axis=-1), camera), nan=-2.0).astype(np.float32)
    return np.ascontiguousarray(mapped[..., 0]), np.ascontiguousarray(mapped[..., 1])


@njit(cache=True, nogil=True)
def measured_at(depth, matrix, row, column, height):  # type: ignore[no-untyped-def]
    """Distance of a grid point, (row, column, height), and the depth of its pixel; 0 depth outside of the image."""
    distance = matrix[2, 0] * row + matrix[2, 1] * column + matrix[2, 2] * height + matrix[2, 3]
    if not distance > 0.0:
        return distance, 0.0
    u = (matrix[0, 0] * row + matrix[0, 1] * column + matrix[0, 2] * height + matrix[0, 3]) / distance + 0.5
    v = (matrix[1, 0] * row + matrix[1, 1] * column + matrix[1, 2] * height + matrix[1, 3]) / distance + 0.5
    rows, columns = depth.shape
    if not (u >= 0.0 and v >= 0.0 and u < columns and v < rows):
        return distance, 0.0
    return distance, float(depth[int(v), int(u)])


@njit(cache=True, nogil=True)
def _looks_through(depth, matrix, row, column, height):  # type: ignore[no-untyped-def]
    """Whether the camera measured a surface behind the point at a (row, column) of the grid and a height."""
    distance, measured = measured_at(depth, matrix, row, column, height)
    return measured < np.inf and measured > distance + SEE_THROUGH


@njit(cache=True, nogil=True)
def _behind(depth, matrix, heights, sources, row, column, row_step, column_step):  # type: ignore[no-untyped-def]
    """First known cell from (row, column) on, in a direction, whose height does not contradict depth; -1 if none."""
    side = heights.shape[0]
    r, c = row + row_step, column + column_step
    while r >= 0.0 and c >= 0.0 and r < side and c < side:
        i, j = int(r), int(c)
        if sources[i, j] >= 0 and not _looks_through(depth, matrix, row, column, heights[i, j]):
            return i * side + j
        r, c = r + row_step, c + column_step
    return -1


@njit(cache=True, nogil=True)
def _replace(shown, heights, sources, depth, matrix, position):  # type: ignore[no-untyped-def]
    side = heights.shape[0]
    for i in range(side):
        for j in range(side):
            nearest = shown[i, j]
            if sources[i, j] >= 0 or nearest < 0:
                continue
            height = heights[nearest // side, nearest % side]
            row, column = i + 0.5, j + 0.5
            if height < SEE_THROUGH or not _looks_through(depth, matrix, row, column, height):
                continue
            row_step, column_step = row - position[0], column - position[1]
            longest = max(abs(row_step), abs(column_step))
            if longest == 0.0:
                continue
            row_step, column_step = row_step / longest, column_step / longest
            found = _behind(depth, matrix, heights, sources, row, column, row_step, column_step)
            if found < 0:
                found = _behind(depth, matrix, heights, sources, row, column, -row_step, -column_step)
            if found >= 0:
                shown[i, j] = found
