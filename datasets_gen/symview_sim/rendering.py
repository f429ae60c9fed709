"""Colour and metric depth images of a PyBullet scene, for any pinhole camera."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Array, Camera, invert_rigid
from symview_sim.bullet import camera_image, pybullet
from symview_sim.camera_rig import CameraImages

NEAR, FAR = 0.05, 4.0  # metres, clipping planes
SCENE, SCENE_RADIUS = np.array([0.45, 0.0, 0.0]), 1.5  # metres: objects and arm lie within
TILE = 0.1  # metres, side of the table's squares
TILE_COLORS = np.array([[206, 200, 190], [188, 182, 172]], dtype=np.uint8)
SKY = np.array([235, 240, 245], dtype=np.uint8)


def render(client: Any, camera: Camera, labelled: bool = False) -> CameraImages:
    """Render a scene that stands on the table z = 0.

    Bodies are drawn by PyBullet's software renderer; the table is computed per pixel, which is exact and costs a third
    of drawing it.

    Args:
        client: PyBullet client whose ground body is invisible.
        camera: where to look from.
        labelled: whether to tell the bodies apart, which takes a tenth longer.
    """
    near, far = NEAR, FAR
    distance = float(np.linalg.norm(camera.position - SCENE))
    if distance + SCENE_RADIUS > FAR:  # a distant camera spends its depth range on the scene
        near, far = distance - SCENE_RADIUS, distance + SCENE_RADIUS
    rgba, zbuffer, mask = camera_image(
        client,
        camera.width,
        camera.height,
        _column_major(invert_rigid(camera.world_from_cam @ np.diag([1.0, -1.0, -1.0, 1.0]))),
        _column_major(_projection_matrix(camera, near, far)),
        shadow=0,
        renderer=pybullet.ER_TINY_RENDERER,
        flags=0 if labelled else pybullet.ER_NO_SEGMENTATION_MASK,
    )
    table_rgb, table_depth = _table(camera)
    rgb, depth = table_rgb.copy(), table_depth.copy()
    buffer = zbuffer.ravel()
    drawn = np.flatnonzero(buffer < 1)  # few pixels: the rest is not touched
    drawn_depth = far * near / (far - (far - near) * buffer[drawn].astype(np.float64))
    behind = depth.ravel()[drawn]
    nearer = (drawn_depth < behind) | (behind == 0)
    drawn, drawn_depth = drawn[nearer], drawn_depth[nearer]
    rgb.reshape(-1, 3)[drawn] = rgba.reshape(-1, 4)[drawn, :3]
    depth.ravel()[drawn] = drawn_depth
    if not labelled:
        return CameraImages(rgb, depth, None)
    labels = np.zeros(depth.shape, dtype=np.uint8)
    loaded = [client.getBodyUniqueId(index) for index in range(client.getNumBodies())]
    labels.ravel()[drawn] = np.searchsorted(loaded, mask.ravel()[drawn])
    return CameraImages(rgb, depth, labels)


@lru_cache(maxsize=64)  # a camera mostly stays where it is
def _table(camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Colour (H, W, 3) and depth (H, W) of an infinite chequered table; its tiles are symmetric about x = 0.45."""
    rotation, position = camera.world_from_cam[:3, :3], camera.position
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays_cam = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
    rays = rays_cam @ rotation.T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -position[2] / rays[..., 2]
    hit = (rays[..., 2] < 0) & (depth < 100.0)
    xy = position[:2] + depth[..., None] * rays[..., :2]
    tile = np.floor((np.where(hit[..., None], xy, 0.0) - (0.45, 0.0)) / TILE + 0.5).astype(np.int64)
    rgb = np.where(hit[..., None], TILE_COLORS[tile.sum(axis=-1) % 2], SKY)
    return rgb, np.where(hit, depth, 0.0).astype(np.float32)


def _projection_matrix(camera: Camera, near: float, far: float) -> Array:
    """OpenGL projection (4, 4) for which PyBullet's software renderer yields the pinhole `camera.intrinsics`.

    TinyRenderer samples a pixel half a pixel to the left of and below its centre (measured; uncorrected, a plane seen
    at 45 degrees unprojects 0.9 mm too high). The principal point is shifted to make up for it.
    """
    fx, fy = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
    cx, cy = camera.intrinsics[:2, 2] + (-0.5, 0.5)
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[0, 2] = 2 * fx / camera.width, 1 - 2 * (cx + 0.5) / camera.width
    matrix[1, 1], matrix[1, 2] = 2 * fy / camera.height, 2 * (cy + 0.5) / camera.height - 1
    matrix[2, 2], matrix[2, 3] = -(far + near) / (far - near), -2 * far * near / (far - near)
    matrix[3, 2] = -1
    return matrix


def _column_major(matrix: Array) -> list[float]:
    return matrix.T.ravel().tolist()
