"""Registration of depth to colour: the depth image that the colour camera would measure.

A depth camera beside the colour camera, as in a RealSense, has its own size, intrinsics and place. Each of its pixels
is a small square, whose bounding box is drawn into the colour image; the nearest one wins.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Array, Camera, Optics, from_ideal, ideal_pixels

LARGEST_MAP = 4  # times the sides of the image: ideal pixels farther out have no depth
OVERLAP = np.float32(
    0.02
)  # pixels of colour by which boxes are enlarged: tilted surfaces and rounding would leave cracks
LENS_OVERLAP = np.float32(0.1)  # with a lens, which bends boxes of which two corners are moved
NO_LENS = (np.empty((0, 0, 2)), 0, 0)


def register_depth(depth: NDArray[np.floating], camera: Camera) -> NDArray[np.float32]:
    """Map the depth image of a camera's depth sensor to the camera's own pixels.

    A pixel of depth covers the colour pixels whose centres lie in its bounding box, so that a surface has no holes
    where depth is coarser than colour. Where several boxes overlap, the nearest one hides the others.

    Args:
        depth: (h, w) float, metres along the optical axis of the depth sensor; 0, negative, infinite and NaN are
            invalid.
        camera: the colour camera, with `depth_sensor`.

    Returns:
        (H, W) float32, metres along the optical axis of the colour camera; 0 where no depth falls.

    Raises:
        CalibrationError: if the camera has no depth sensor, or the sensor's principal point lies outside the image.
    """
    if camera.depth_sensor is None:
        raise CalibrationError("the camera has no depth sensor of its own")
    color_from_sensor = _color_from_sensor(camera, *depth.shape)
    registered = np.full((camera.height, camera.width), np.inf, dtype=np.float32)
    lens_map, overlap = (NO_LENS, OVERLAP) if camera.lens is None else (_lens_map(camera.optics), LENS_OVERLAP)
    _draw(np.ascontiguousarray(depth), *color_from_sensor, *lens_map, overlap, registered)
    registered[np.isinf(registered)] = 0
    return registered


@lru_cache(maxsize=64)
def _color_from_sensor(camera: Camera, rows: int, columns: int) -> tuple[Array, Array]:
    """Return M (3, 3) and m (3,): sensor pixel (u, v) at depth d maps to d M (u, v, 1) + m = d' (u', v', 1)."""
    sensor = camera.depth_camera(rows, columns)
    color_from_depth = camera.cam_from_world @ sensor.world_from_cam
    rays = camera.intrinsics @ color_from_depth[:3, :3] @ np.linalg.inv(sensor.intrinsics)
    return np.ascontiguousarray(rays), camera.intrinsics @ color_from_depth[:3, 3]


@lru_cache(maxsize=8)
def _lens_map(optics: Optics) -> tuple[Array, int, int]:
    """Return the pixels (h, w, 2) of integer ideal pixels, and the ideal row and column of the first of them."""
    lens, fx, fy, cx, cy, height, width = optics
    intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    camera = Camera(intrinsics, np.eye(4), height, width, lens)
    ranges = []
    for ideal, side in zip(ideal_pixels(camera.optics)[::-1], (height, width), strict=True):
        margin = (LARGEST_MAP - 1) * side // 2
        ranges.append((max(int(ideal.min()) - 2, -margin), min(int(ideal.max()) + 3, side + margin)))
    (top, bottom), (left, right) = ranges
    u, v = np.meshgrid(np.arange(left, right, dtype=np.float64), np.arange(top, bottom, dtype=np.float64))
    return from_ideal(np.stack([u, v], axis=-1), camera), top, left


@njit(cache=True, nogil=True)
def _draw(depth, rays, origin, pixels, map_top, map_left, overlap, registered):  # type: ignore[no-untyped-def]
    rows, columns = depth.shape
    height, width = registered.shape
    registered = registered.ravel()
    first, wide = np.empty(columns, dtype=np.int32), np.empty(columns, dtype=np.int32)
    high, nearness = np.empty(columns, dtype=np.int32), np.empty(columns, dtype=np.float32)
    boxes = (first, wide, high, nearness)
    for v in range(rows):
        if len(pixels):
            _boxes_through_lens(depth[v], v, rays, origin, pixels, map_top, map_left, overlap, height, width, boxes)
        else:
            _boxes(depth[v], v, rays, origin, overlap, height, width, boxes)
        _draw_boxes(first, wide, high, nearness, registered, np.uint64(width))


# Indices are unsigned, since numba checks whether signed ones count from the end of the array.
@njit(cache=True, nogil=True)
def _draw_boxes(first, wide, high, nearness, registered, width):  # type: ignore[no-untyped-def]
    for u in range(len(first)):
        w = nearness[u]
        if w < np.inf:
            start = np.uint64(first[u])
            if wide[u] <= 2 and high[u] <= 2:  # nearly all boxes; its first and last column may be the same
                end = start + np.uint64(wide[u] - 1)
                registered[start] = min(w, registered[start])
                registered[end] = min(w, registered[end])
                if high[u] == 2:
                    start, end = start + width, end + width
                    registered[start] = min(w, registered[start])
                    registered[end] = min(w, registered[end])
            else:
                for row in range(np.uint64(high[u])):
                    for column in range(np.uint64(wide[u])):
                        pixel = start + row * width + column
                        registered[pixel] = min(w, registered[pixel])


# Float32 tells pixels to 1e-4. The loop has no branches and few arrays, so that it compiles to vector instructions: it
# takes a third of the time, drawing takes the rest (`symview-benchmark views`).
@njit(cache=True, nogil=True, error_model="numpy")
def _boxes(depth, v, rays, origin, overlap, height, width, boxes):  # type: ignore[no-untyped-def]
    """Write the first pixel, columns, rows and depth of what each sensor pixel of a row covers; depth inf if none."""
    first, wide, high, nearness = boxes
    u_step, v_step, w_step = np.float32(rays[0, 0]), np.float32(rays[1, 0]), np.float32(rays[2, 0])
    u_start, v_start, w_start = np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2])
    u_row, v_row = np.float32(rays[0, 1] * v + rays[0, 2]), np.float32(rays[1, 1] * v + rays[1, 2])
    w_row = np.float32(rays[2, 1] * v + rays[2, 2])
    # Half the extent of a sensor pixel in the image, per metre of depth and times the depth there.
    u_half = np.float32((abs(rays[0, 0]) + abs(rays[0, 1])) / 2)
    v_half = np.float32((abs(rays[1, 0]) + abs(rays[1, 1])) / 2)
    columns = np.int32(width)
    for u in range(len(depth)):
        distance, column = np.float32(depth[u]), np.float32(u)
        w = distance * (w_step * column + w_row) + w_start
        inverse = np.float32(1) / w
        x = (distance * (u_step * column + u_row) + u_start) * inverse
        y = (distance * (v_step * column + v_row) + v_start) * inverse
        x_half, y_half = distance * u_half * inverse + overlap, distance * v_half * inverse + overlap
        left, right = _bound(x - x_half, width), _bound(x + x_half, width)
        top, bottom = _bound(y - y_half, height), _bound(y + y_half, height)
        first[u], wide[u], high[u] = top * columns + left, right - left, bottom - top
        is_finite = distance < np.inf and x_half < np.inf and y_half < np.inf
        is_drawn = distance > 0 and is_finite and w > 0 and right > left and bottom > top
        nearness[u] = w if is_drawn else np.float32(np.inf)


@njit(cache=True, nogil=True)
def _boxes_through_lens(  # type: ignore[no-untyped-def]
    depth, v, rays, origin, pixels, map_top, map_left, overlap, height, width, boxes
):
    """Write what `_boxes` does, with two opposite corners moved by the lens."""
    first, wide, high, nearness = boxes
    u_half, v_half = (abs(rays[0, 0]) + abs(rays[0, 1])) / 2, (abs(rays[1, 0]) + abs(rays[1, 1])) / 2
    for u in range(len(depth)):
        nearness[u] = np.inf
        distance = np.float64(depth[u])
        w = distance * (rays[2, 0] * u + rays[2, 1] * v + rays[2, 2]) + origin[2]
        if distance > 0 and distance < np.inf and w > 0:
            x = (distance * (rays[0, 0] * u + rays[0, 1] * v + rays[0, 2]) + origin[0]) / w
            y = (distance * (rays[1, 0] * u + rays[1, 1] * v + rays[1, 2]) + origin[1]) / w
            x_half, y_half = distance * u_half / w, distance * v_half / w
            u_0, v_0 = _through_lens(x - x_half, y - y_half, pixels, map_top, map_left)
            u_1, v_1 = _through_lens(x + x_half, y + y_half, pixels, map_top, map_left)
            if not np.isnan(u_0 + u_1):
                left, right = _bound(u_0 - overlap, width), _bound(u_1 + overlap, width)
                top, bottom = _bound(v_0 - overlap, height), _bound(v_1 + overlap, height)
                if right > left and bottom > top:
                    first[u], wide[u], high[u], nearness[u] = top * width + left, right - left, bottom - top, w


@njit(cache=True, nogil=True)
def _bound(edge, side):  # type: ignore[no-untyped-def]
    """First pixel centre at or behind an edge, from 0 to `side`; 0 for NaN."""
    first = np.ceil(np.float32(edge))
    return np.int32(min(first if first > 0 else np.float32(0), np.float32(side)))


@njit(cache=True, nogil=True)
def _through_lens(u, v, pixels, top, left):  # type: ignore[no-untyped-def]
    """Pixel of an ideal pixel, by bilinear interpolation; NaN outside the map, which is outside the image."""
    row, column = v - top, u - left
    if not (row >= 0.0 and column >= 0.0 and row < pixels.shape[0] - 1 and column < pixels.shape[1] - 1):
        return np.nan, np.nan
    i, j = int(row), int(column)
    b, a = row - i, column - j
    p = (1 - b) * ((1 - a) * pixels[i, j, 0] + a * pixels[i, j + 1, 0])
    p += b * ((1 - a) * pixels[i + 1, j, 0] + a * pixels[i + 1, j + 1, 0])
    q = (1 - b) * ((1 - a) * pixels[i, j, 1] + a * pixels[i, j + 1, 1])
    q += b * ((1 - a) * pixels[i + 1, j, 1] + a * pixels[i + 1, j + 1, 1])
    return p, q
