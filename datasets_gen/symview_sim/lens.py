"""What a camera with a lens sees: the image of a wider pinhole camera, resampled.

Each pixel takes colour, depth and label of the nearest pixel of an image with three times as many in a row, at most a
sixth of a pixel away along each axis where the lens keeps the scale. Nothing is averaged: a mean of two depths lies on
neither surface, and a mean of colours differs from what the simulators draw without a lens. Depth is along the optical
axis, which is that of the wider camera, so it stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera, ideal_pixels
from symview_sim.camera_rig import CameraImages

SAMPLES = 3  # pixels of the wider image for one of the camera's, along each axis
LARGEST = 8192  # rows or columns of the wider image


def through_lens(draw: Callable[[Camera], CameraImages], camera: Camera) -> CameraImages:
    """Return what a camera sees, with or without a lens.

    Args:
        draw: renders what a pinhole camera sees.
        camera: the camera.

    Raises:
        CalibrationError: as `pinhole_camera`.
    """
    if camera.lens is None:
        return draw(camera)
    wide = pinhole_camera(camera)
    rows, columns = _nearest_pixels(camera, wide)
    rgb, depth, labels = draw(wide)
    labels = None if labels is None else labels[rows, columns]
    return CameraImages(rgb[rows, columns], depth[rows, columns], labels)


@lru_cache(maxsize=64)  # the same object again, for what is cached by camera
def pinhole_camera(camera: Camera) -> Camera:
    """Return the pinhole camera whose image has all that a camera sees; a camera without a lens itself.

    Raises:
        CalibrationError: if the lens is so wide that its image would have more than 8192 rows or columns.
    """
    if camera.lens is None:
        return camera
    ideal = ideal_pixels(camera.optics)
    first, last = (np.array([bound(plane) for plane in ideal]) for bound in (np.min, np.max))
    sides = np.ceil(SAMPLES * (last - first)) + 1
    if sides.max() > LARGEST:
        angle = np.rad2deg(np.arctan(np.hypot(*_slopes(camera, ideal)).max()))
        raise CalibrationError(
            f"the {camera.lens.model} lens shows rays up to {angle:.0f} degrees from the optical axis, for which the "
            f"simulator would render {sides[1]:.0f} x {sides[0]:.0f} pixels, at most {LARGEST} a side: use a lens that "
            "is less wide, or a smaller image"
        )
    width, height = sides.astype(int).tolist()
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2, 2] -= first
    intrinsics[:2] *= SAMPLES
    return replace(camera, intrinsics=intrinsics, height=height, width=width, lens=None, depth_sensor=None)


def _slopes(camera: Camera, ideal: tuple[NDArray[np.float64], NDArray[np.float64]]) -> list[NDArray[np.float64]]:
    """Return x/z and y/z of the rays of ideal pixels."""
    return [(ideal[0] - camera.cx) / camera.fx, (ideal[1] - camera.cy) / camera.fy]


@lru_cache(maxsize=8)
def _nearest_pixels(camera: Camera, wide: Camera) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns (H, W) of the wider image where the rays of a camera's pixels are."""
    x, y = _slopes(camera, ideal_pixels(camera.optics))
    rows, columns = np.rint(y * wide.fy + wide.cy), np.rint(x * wide.fx + wide.cx)
    return rows.astype(np.intp), columns.astype(np.intp)
