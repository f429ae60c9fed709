"""Orthographic z-buffer: points, or the pixels of depth images, drawn from above, the highest in front.

Compiled with numba. A cell's point is the one of greatest height, in float32; of equals, the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Array, Camera
from lerobot_symview.geometry.workspace import Workspace

EMPTY = -1  # source of a cell that no point fell into


class ZBuffer(NamedTuple):
    """What is highest in each cell of a top-down grid of P x P cells.

    Attributes:
        height: (P, P) float32, metres above the table; 0 where nothing is.
        source: (P, P) int32, index of the point; `EMPTY` where nothing is.
    """

    height: NDArray[np.float32]
    source: NDArray[np.int32]


def zbuffer_from_points(points: Array, workspace: Workspace, pixels: int, ceiling: float = np.inf) -> ZBuffer:
    """Draw points from above (paper Eq. 5-6).

    Args:
        points: (N, 3) float64 world coordinates, metres; a point that is not finite is left out.
        workspace: what the grid covers.
        pixels: side of the grid.
        ceiling: metres above the table; what is higher is left out.

    Returns:
        A buffer whose source is the index of the point. Points outside the workspace's square are nowhere.
    """
    buffer = _cleared(pixels)
    rows_columns = workspace.pixel_from_xy(points[:, :2], pixels) + 0.5
    _draw_points(rows_columns, points[:, 2], ceiling, *buffer)
    return buffer


def zbuffer_from_depth(
    depths: Sequence[NDArray[np.floating]],
    cameras: Sequence[Camera],
    workspace: Workspace,
    pixels: int,
    ceiling: float = np.inf,
) -> ZBuffer:
    """Draw the pixels of depth images, from one camera or several, from above (paper Eq. 2-6).

    The same as `unproject` and `zbuffer_from_points`, in one pass and without the points.

    Args:
        depths: (H, W) float each, metres along the optical axis; 0, negative, infinite and NaN are left out.
        cameras: their calibrations.
        workspace: what the grid covers.
        pixels: side of the grid.
        ceiling: metres above the table; what is higher is left out.

    Returns:
        A buffer whose source is the index of the pixel, row by row, one image after the other.

    Raises:
        ValueError: if an image's size is not its camera's.
    """
    buffer = _cleared(pixels)
    first = 0
    for depth, camera in zip(depths, cameras, strict=True):
        if depth.shape != (camera.height, camera.width):
            raise ValueError(f"depth has shape {depth.shape}, the camera is {(camera.height, camera.width)}")
        _draw_depth(depth, *grid_from_pixel(camera, workspace, pixels), ceiling, first, *buffer)
        first += depth.size
    return buffer


def gather(
    shown: NDArray[np.int32], buffer: ZBuffer, colors: NDArray[np.uint8]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Look up what is drawn.

    Args:
        shown: (P, P) int32, which cell of the buffer each pixel shows, row-major; -1 shows nothing.
        buffer: what is highest in each cell.
        colors: (N, 3) uint8, the colour of every source.

    Returns:
        (P, P, 3) uint8 colours and (P, P) float32 heights; black and 0 where nothing is shown.
    """
    rgb = np.zeros((*shown.shape, 3), dtype=np.uint8)
    height = np.zeros(shown.shape, dtype=np.float32)
    _gather(shown, buffer.height, buffer.source, colors, rgb, height)
    return rgb, height


def _cleared(pixels: int) -> ZBuffer:
    return ZBuffer(np.zeros((pixels, pixels), np.float32), np.full((pixels, pixels), EMPTY, np.int32))


@lru_cache(maxsize=256)
def grid_from_pixel(camera: Camera, workspace: Workspace, pixels: int) -> tuple[Array, Array]:
    """Return A (3, 3) and b (3,): pixel (u, v) at depth d lies at d A (u, v, 1) + b in (row, column, height).

    This is paper Eq. 2-6 in one, as float64. Pixels are integers at their centres, depth is in metres along the optical
    axis; rows and columns count from the grid's edge, in cells; heights are metres above the table.
    """
    scale = np.array([pixels / workspace.size, pixels / workspace.size, 1.0])
    rays = camera.world_from_cam[:3, :3] @ np.linalg.inv(camera.intrinsics)
    origin = camera.position - np.array([*workspace.center, 0.0])
    return np.ascontiguousarray(scale[:, None] * rays), scale * origin + [pixels / 2, pixels / 2, 0.0]


@njit(cache=True, nogil=True)
def _cell(row, column, side):  # type: ignore[no-untyped-def]
    """Row-major index of the cell of a continuous (row, column) whose integers are edges; -1 outside and for NaN."""
    if row >= 0.0 and column >= 0.0 and row < side and column < side:
        return int(row) * side + int(column)
    return -1


@njit(cache=True, nogil=True)
def _draw_points(rows_columns, heights, ceiling, height, source):  # type: ignore[no-untyped-def]
    side = height.shape[0]
    height, source = height.ravel(), source.ravel()
    for index in range(len(heights)):
        z = heights[index]
        if z <= ceiling and z > -np.inf and z < np.inf:
            cell = _cell(rows_columns[index, 0], rows_columns[index, 1], side)
            rounded = np.float32(z)
            if cell >= 0 and (source[cell] < 0 or rounded > height[cell]):
                height[cell] = rounded
                source[cell] = index


@njit(cache=True, nogil=True)
def _draw_depth(depth, rays, origin, ceiling, first, height, source):  # type: ignore[no-untyped-def]
    side = height.shape[0]
    height, source = height.ravel(), source.ravel()
    rows, columns = depth.shape
    for v in range(rows):
        row_ray = rays[0, 1] * v + rays[0, 2]
        column_ray = rays[1, 1] * v + rays[1, 2]
        height_ray = rays[2, 1] * v + rays[2, 2]
        for u in range(columns):
            distance = np.float64(depth[v, u])
            if distance > 0.0 and distance < np.inf:
                z = origin[2] + distance * (rays[2, 0] * u + height_ray)
                if z <= ceiling:
                    row = origin[0] + distance * (rays[0, 0] * u + row_ray)
                    column = origin[1] + distance * (rays[1, 0] * u + column_ray)
                    cell = _cell(row, column, side)
                    rounded = np.float32(z)
                    if cell >= 0 and (source[cell] < 0 or rounded > height[cell]):
                        height[cell] = rounded
                        source[cell] = first + v * columns + u


@njit(cache=True, nogil=True)
def _gather(shown, heights, sources, colors, rgb, height):  # type: ignore[no-untyped-def]
    shown, heights, sources = shown.ravel(), heights.ravel(), sources.ravel()
    colors, rgb, height = colors.ravel(), rgb.ravel(), height.ravel()
    for pixel in range(len(shown)):
        cell = shown[pixel]
        if cell >= 0 and sources[cell] >= 0:
            height[pixel] = heights[cell]
            color = 3 * sources[cell]
            for channel in range(3):
                rgb[3 * pixel + channel] = colors[color + channel]
