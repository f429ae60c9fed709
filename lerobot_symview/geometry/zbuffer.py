"""Orthographic top-down z-buffer of points or a depth image: each cell keeps its highest point.

Compiled with numba. Heights are compared in float32; ties go to the first point.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Array, Camera, ideal_pixels
from lerobot_symview.geometry.workspace import Workspace

EMPTY = -1  # source of a cell without points


class ZBuffer(NamedTuple):
    """The highest point of each cell in a top-down grid of P x P cells.

    Attributes:
        height: (P, P) float32, metres above the table; 0 in empty cells.
        source: (P, P) int32, index of the point; `EMPTY` in empty cells.
    """

    height: NDArray[np.float32]
    source: NDArray[np.int32]


def zbuffer_from_points(points: Array, workspace: Workspace, pixels: int, ceiling: float = np.inf) -> ZBuffer:
    """Render points into a top-down z-buffer (paper Eq. 5-6).

    Args:
        points: (N, 3) float64 world coordinates, metres; non-finite points are ignored.
        workspace: the square on the table that the grid covers.
        pixels: rows and columns of the grid.
        ceiling: metres above the table; higher points are ignored.

    Returns:
        A buffer whose source is the point's index. Points outside the workspace's square are ignored.
    """
    buffer = empty_buffer(pixels)
    rows_columns = workspace.pixel_from_xy(points[:, :2], pixels) + 0.5
    _draw_points(rows_columns, points[:, 2], ceiling, *buffer)
    return buffer


def zbuffer_from_depth(
    depth: NDArray[np.floating],
    camera: Camera,
    workspace: Workspace,
    pixels: int,
    ceiling: float = np.inf,
    floor: float = -np.inf,
) -> ZBuffer:
    """Render a depth image into a top-down z-buffer (paper Eq. 2-6).

    Equivalent to `unproject` and `zbuffer_from_points`, in one pass and without an array of points.

    Args:
        depth: (H, W) float, metres along the optical axis; 0, negative, infinite and NaN are ignored.
        camera: its calibration.
        workspace: the square on the table that the grid covers.
        pixels: rows and columns of the grid.
        ceiling: metres above the table; higher points are ignored.
        floor: metres above the table, negative below it; lower points are ignored.

    Returns:
        A buffer whose source is the row-major index of the pixel.

    Raises:
        ValueError: if the depth image and the camera differ in size.
    """
    if depth.shape != (camera.height, camera.width):
        raise ValueError(f"depth has shape {depth.shape}, the camera is {(camera.height, camera.width)}")
    buffer, grid = empty_buffer(pixels), grid_from_pixel(camera, workspace, pixels)
    if camera.lens is None:
        _draw_depth(depth, *grid, floor, ceiling, *buffer)
    else:
        _draw_depth_through_lens(depth, *ideal_pixels(camera.optics), *grid, floor, ceiling, *buffer)
    return buffer


def gather(
    shown: NDArray[np.int32], buffer: ZBuffer, images: Sequence[NDArray[np.uint8]]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Look up the colour and height that each pixel shows.

    Args:
        shown: (P, P) int32, row-major index of the cell that each pixel shows; -1 for none.
        buffer: the z-buffer.
        images: (H, W, 3) uint8 each, whose pixels, counted over all images in order, are the sources.

    Returns:
        (P, P, 3) uint8 colours and (P, P) float32 heights; black and 0 where no point is shown.
    """
    rgb = np.zeros((*shown.shape, 3), dtype=np.uint8)
    height = np.zeros(shown.shape, dtype=np.float32)
    first = 0
    for image in images:
        _gather(shown, buffer.height, buffer.source, np.ascontiguousarray(image), first, rgb, height)
        first += image.shape[0] * image.shape[1]
    return rgb, height


def empty_buffer(pixels: int) -> ZBuffer:
    """Return a buffer of cells without points."""
    return ZBuffer(np.zeros((pixels, pixels), np.float32), np.full((pixels, pixels), EMPTY, np.int32))


@lru_cache(maxsize=256)
def grid_from_pixel(camera: Camera, workspace: Workspace, pixels: int) -> tuple[Array, Array]:
    """Return A (3, 3) and b (3,): ideal pixel (u, v) at depth d maps to (row, column, height) = d A (u, v, 1) + b.

    A and b are float64 and combine paper Eq. 2-6. Integer (u, v) are pixel centres; depth is in metres along the
    optical axis; rows and columns are in cells, measured from the grid's edge; height is in metres above the table.
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


# The three kernels repeat how a cell is drawn: a function of its own that gets the arrays makes a view take 1.5 to 2.6
# times as long, inlined or not (`symview-benchmark views`).
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
def _draw_depth(depth, rays, origin, floor, ceiling, height, source):  # type: ignore[no-untyped-def]
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
                if z <= ceiling and z >= floor:
                    row = origin[0] + distance * (rays[0, 0] * u + row_ray)
                    column = origin[1] + distance * (rays[1, 0] * u + column_ray)
                    cell = _cell(row, column, side)
                    rounded = np.float32(z)
                    if cell >= 0 and (source[cell] < 0 or rounded > height[cell]):
                        height[cell] = rounded
                        source[cell] = v * columns + u


@njit(cache=True, nogil=True)
def _draw_depth_through_lens(depth, us, vs, rays, origin, floor, ceiling, height, source):  # type: ignore[no-untyped-def]
    """Draw as `_draw_depth` does, with the same rounding, but look up the ideal pixels."""
    side = height.shape[0]
    height, source = height.ravel(), source.ravel()
    rows, columns = depth.shape
    for i in range(rows):
        for j in range(columns):
            distance = np.float64(depth[i, j])
            if distance > 0.0 and distance < np.inf:
                u, v = us[i, j], vs[i, j]
                z = origin[2] + distance * (rays[2, 0] * u + (rays[2, 1] * v + rays[2, 2]))
                if z <= ceiling and z >= floor:
                    row = origin[0] + distance * (rays[0, 0] * u + (rays[0, 1] * v + rays[0, 2]))
                    column = origin[1] + distance * (rays[1, 0] * u + (rays[1, 1] * v + rays[1, 2]))
                    cell = _cell(row, column, side)
                    rounded = np.float32(z)
                    if cell >= 0 and (source[cell] < 0 or rounded > height[cell]):
                        height[cell] = rounded
                        source[cell] = i * columns + j


@njit(cache=True, nogil=True)
def _gather(shown, heights, sources, colors, first, rgb, height):  # type: ignore[no-untyped-def]
    shown, heights, sources = shown.ravel(), heights.ravel(), sources.ravel()
    colors, rgb, height = colors.ravel(), rgb.ravel(), height.ravel()
    for pixel in range(len(shown)):
        cell = shown[pixel]
        if cell >= 0:
            color = 3 * (sources[cell] - first)
            if color >= 0 and color < len(colors):
                height[pixel] = heights[cell]
                for channel in range(3):
                    rgb[3 * pixel + channel] = colors[color + channel]
