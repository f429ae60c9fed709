"""Splats: a pixel covers its footprint on a horizontal surface, so that empty cells are what the camera cannot see.

A pixel of a camera that looks at 45 degrees covers more of the table than a cell. Without splats the cells between the
pixels' centres are empty.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Array, Camera, Optics, ideal_pixels
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.geometry.zbuffer import ZBuffer, grid_from_pixel

REACH = 8.0  # cells from a pixel's point that its footprint covers at most: it is unbounded at the horizon


def with_splats(
    buffer: ZBuffer,
    depths: Sequence[NDArray[np.floating]],
    cameras: Sequence[Camera],
    workspace: Workspace,
) -> ZBuffer:
    """Return a z-buffer whose empty cells show the highest of the pixels beside empty cells that cover their centre.

    The footprint of a pixel is the parallelogram, on the horizontal plane through its point, that its four corners see,
    up to 8 cells away. Cells that have a point keep it.

    Args:
        buffer: (P, P), the points of the depth images that are shown.
        depths: (H, W) float of each camera, metres along the optical axis.
        cameras: their calibrations.
        workspace: the square on the table that the grid covers.

    Returns:
        Heights and sources as in the buffer, counted over all images in order; of equally high pixels, the first.
    """
    height, source = buffer.height.copy(), buffer.source.copy()
    first = 0
    for depth, camera in zip(depths, cameras, strict=True):
        grid = grid_from_pixel(camera, workspace, len(height))
        _draw_footprints(depth, *_all_pixels(camera.optics), *grid, first, buffer.source, height, source)
        first += depth.size
    return ZBuffer(height, source)


@lru_cache(maxsize=8)
def _all_pixels(optics: Optics) -> tuple[Array, Array]:
    """Return u and v (H, W) of the ideal pixels."""
    u, v = (np.ascontiguousarray(np.broadcast_to(plane, optics[-2:])) for plane in ideal_pixels(optics))
    return u, v


@njit(cache=True, nogil=True)
def _is_beside_empty(points, row, column):  # type: ignore[no-untyped-def]
    side = points.shape[0]
    for r in range(max(0, row - 1), min(side, row + 2)):
        for c in range(max(0, column - 1), min(side, column + 2)):
            if points[r, c] < 0:
                return True
    return False


@njit(cache=True, nogil=True)
def _draw_footprints(depth, us, vs, rays, origin, first, points, height, source):  # type: ignore[no-untyped-def]
    side, columns = height.shape[0], depth.shape[1]
    for cell in range(side * side):
        pixel = points[cell // side, cell % side] - first
        if pixel < 0 or pixel >= depth.size or not _is_beside_empty(points, cell // side, cell % side):
            continue
        i, j = pixel // columns, pixel % columns
        distance, u, v = np.float64(depth[i, j]), us[i, j], vs[i, j]
        ray_z = rays[2, 0] * u + (rays[2, 1] * v + rays[2, 2])
        if not ray_z < 0.0:
            continue
        ray_row = rays[0, 0] * u + (rays[0, 1] * v + rays[0, 2])
        ray_column = rays[1, 0] * u + (rays[1, 1] * v + rays[1, 2])
        row, column = origin[0] + distance * ray_row, origin[1] + distance * ray_column
        # derivatives of the point by u and v on the plane of its height
        slope_u, slope_v = rays[2, 0] / ray_z, rays[2, 1] / ray_z
        row_u, row_v = distance * (rays[0, 0] - ray_row * slope_u), distance * (rays[0, 1] - ray_row * slope_v)
        column_u = distance * (rays[1, 0] - ray_column * slope_u)
        column_v = distance * (rays[1, 1] - ray_column * slope_v)
        area = abs(row_u * column_v - row_v * column_u)
        reach_row = min(0.5 * (abs(row_u) + abs(row_v)), REACH)
        reach_column = min(0.5 * (abs(column_u) + abs(column_v)), REACH)
        z = np.float32(origin[2] + distance * ray_z)
        first_column = max(0, int(np.ceil(column - reach_column - 0.5)))
        last_column = min(side, int(column + reach_column + 0.5))
        for r in range(max(0, int(np.ceil(row - reach_row - 0.5))), min(side, int(row + reach_row + 0.5))):
            for c in range(first_column, last_column):
                if points[r, c] >= 0:
                    continue
                other = source[r, c]
                if other >= 0 and (z < height[r, c] or (z == height[r, c] and first + pixel > other)):
                    continue
                down, right = r + 0.5 - row, c + 0.5 - column
                covers_v = 2.0 * abs(down * column_v - right * row_v) <= area
                if covers_v and 2.0 * abs(right * row_u - down * column_u) <= area:
                    height[r, c], source[r, c] = z, first + pixel
