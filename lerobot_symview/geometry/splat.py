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
    for own_row in range(side):
        for own_column in range(side):
            pixel = points[own_row, own_column] - first
            if pixel < 0 or pixel >= depth.size or not _is_beside_empty(points, own_row, own_column):
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
            # The footprint is where |down column_v - right row_v| and |right row_u - down column_u| are at most half of
            # its area: in every row, the cells in both of two intervals.
            half_area = 0.5 * abs(row_u * column_v - row_v * column_u)
            row_u, row_v = _away_from_zero(row_u), _away_from_zero(row_v)
            skew_u, skew_v = column_u / row_u, column_v / row_v
            half_u, half_v = half_area / abs(row_u), half_area / abs(row_v)
            reach = min(0.5 * (abs(row_u) + abs(row_v)), REACH)
            z = np.float32(origin[2] + distance * ray_z)
            for r in range(max(0, int(np.ceil(row - reach - 0.5))), min(side, int(row + reach + 0.5))):
                down = r + 0.5 - row
                left = max(down * skew_u - half_u, down * skew_v - half_v, -REACH)
                right = min(down * skew_u + half_u, down * skew_v + half_v, REACH)
                for c in range(
                    max(0, int(np.ceil(column + left - 0.5))), min(side, int(np.floor(column + right + 0.5)))
                ):
                    if points[r, c] >= 0:
                        continue
                    other = source[r, c]
                    if other < 0 or z > height[r, c] or (z == height[r, c] and first + pixel < other):
                        height[r, c], source[r, c] = z, first + pixel


@njit(cache=True, nogil=True)
def _away_from_zero(value):  # type: ignore[no-untyped-def]
    """The value, or a tiny one for zero: an interval is infinite then."""
    return value if abs(value) > 1e-9 else 1e-9
