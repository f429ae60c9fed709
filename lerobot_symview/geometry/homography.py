"""Homography of a plane parallel to the table, and its warp to a top-down image (paper section 4.2).

With a lens, the homography maps to the camera's ideal pixels and the warp continues to its pixels.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Array, Camera, from_ideal
from lerobot_symview.geometry.workspace import Workspace

FARTHEST = 30_000.0  # pixels; within int16


class WarpMap(NamedTuple):
    """Maps for `cv2.remap`, in its fixed-point format: see `warp_map`."""

    whole: NDArray[np.int16]
    fraction: NDArray[np.uint16]


def image_from_topdown(camera: Camera, workspace: Workspace, pixels: int, plane_height: float = 0.0) -> Array:
    """Return the homography (3, 3) from top-down pixels (column, row, 1) to ideal pixels (u, v, 1), up to scale.

    The plane lies `plane_height` metres above the table. y = K(Rx + t) restricted to that plane is itself a
    homography, so no linear system is solved: the workspace corners map to the image corners by construction.

    Raises:
        CalibrationError: if a corner of the plane lies behind the camera, or the camera lies in the plane.
    """
    cam_from_world = camera.cam_from_world
    if (cam_from_world[2, :3] @ workspace.corners(plane_height).T + cam_from_world[2, 3] <= 0).any():
        raise CalibrationError(f"the workspace at height {plane_height:g} m lies partly behind the camera")
    if abs(camera.position[2] - plane_height) < 1e-6:
        raise CalibrationError(f"the camera lies in the plane at height {plane_height:g} m and sees it edge-on")
    resolution = workspace.size / pixels
    world_from_topdown = np.array(
        [
            [0, resolution, workspace.center[0] + (0.5 / pixels - 0.5) * workspace.size],
            [resolution, 0, workspace.center[1] + (0.5 / pixels - 0.5) * workspace.size],
            [0, 0, plane_height],
            [0, 0, 1],
        ]
    )
    return camera.intrinsics @ cam_from_world[:3] @ world_from_topdown


@lru_cache(maxsize=64)
def warp_map(camera: Camera, workspace: Workspace, pixels: int, plane_height: float = 0.0) -> WarpMap:
    """Return the camera pixel of each pixel of the top-down image, for `warp_plane`.

    Maps of recent cameras and planes are cached, since computing one takes longer than applying it.

    Returns:
        (pixels, pixels, 2) int16, integer part of the camera pixels (u, v), and (pixels, pixels) uint16, their
        fractional parts in steps of 1/32 pixel: OpenCV's fixed-point format.

    Raises:
        CalibrationError: for the same reasons as `image_from_topdown`.
    """
    homography = image_from_topdown(camera, workspace, pixels, plane_height)
    columns, rows = np.meshgrid(np.arange(pixels), np.arange(pixels))
    u, v, w = homography @ np.stack([columns.ravel(), rows.ravel(), np.ones(pixels**2)])
    # Pixels outside the image are black at any distance; clip to the range of int16.
    image_xy = from_ideal(np.stack([u, v], axis=-1) / w[:, None], camera)
    image_xy = np.clip(image_xy, -FARTHEST, FARTHEST).astype(np.float32)
    whole, fraction = cv2.convertMaps(image_xy.reshape(pixels, pixels, 2), None, cv2.CV_16SC2)
    return WarpMap(whole, fraction)


def warp_plane(rgb: NDArray[np.uint8], image_from_topdown: WarpMap) -> NDArray[np.uint8]:
    """Warp a camera image to the top-down image of a plane (paper section 4.2).

    Args:
        rgb: (H, W, 3) uint8.
        image_from_topdown: the maps from `warp_map` for the image's camera.

    Returns:
        (pixels, pixels, 3) uint8, bilinearly interpolated, black where the plane lies outside the image.
    """
    return np.asarray(cv2.remap(rgb, *image_from_topdown, cv2.INTER_LINEAR), dtype=np.uint8)


def inside_image(image_from_topdown: WarpMap, camera: Camera) -> NDArray[np.bool_]:
    """Return (pixels, pixels) bool, which pixels of a top-down image lie within the camera's image."""
    u, v = image_from_topdown.whole[..., 0], image_from_topdown.whole[..., 1]
    return (u >= 0) & (v >= 0) & (u < camera.width - 1) & (v < camera.height - 1)


@lru_cache(maxsize=64)
def pixel_density(camera: Camera, workspace: Workspace, pixels: int, plane_height: float = 0.0) -> NDArray[np.float32]:
    """Return how many of a camera's pixels show a square metre of a plane, at every pixel of its top-down image.

    It is the Jacobian determinant of the plane's homography, fx fy h / d^3, for a camera at the height h above the
    plane that sees the place at the depth d along its optical axis: it grows with resolution and angle, and falls with
    distance.

    Returns:
        (pixels, pixels) float32; 0 behind the camera.
    """
    rows, columns = np.meshgrid(np.arange(pixels), np.arange(pixels), indexing="ij")
    xy = workspace.xy_from_pixel(np.stack([rows, columns], axis=-1), pixels)
    axis = camera.cam_from_world[2]
    depth = xy @ axis[:2] + axis[2] * plane_height + axis[3]
    with np.errstate(divide="ignore"):
        density = camera.fx * camera.fy * abs(camera.position[2] - plane_height) / depth**3
    return np.where(depth > 0, density, 0.0).astype(np.float32)


def camera_direction(camera: Camera, workspace: Workspace) -> Array:
    """Return the horizontal unit vector (2,) from the workspace centre to the camera; zero if the camera is above it.

    The vector transforms as irrep(1, 1) and gives an equivariant network the viewing direction (paper section 4.2).
    """
    offset = camera.position[:2] - np.asarray(workspace.center)
    length = np.linalg.norm(offset)
    return offset / length if length > 1e-9 else np.zeros(2)
