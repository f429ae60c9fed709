"""Rendered photographs of a table with a texture, through a lens and with noise."""

import cv2
import numpy as np

from lerobot_symview.geometry.camera import ideal_pixels

TABLE = (0.45, 0.0, 0.0)  # centre of the textured square
SIDE, RESOLUTION = 1.6, 800  # of the texture, metres and pixels


def textured_table(camera, seed=0, texture=0, noise=2.0):
    """Return the image (H, W, 3) of a table with random spots; `texture` chooses the spots, `seed` the noise."""
    rng = np.random.default_rng(texture)
    spots = cv2.GaussianBlur(rng.random((RESOLUTION, RESOLUTION)).astype(np.float32), (0, 0), 4)
    spots = cv2.normalize(spots, None, 30, 220, cv2.NORM_MINMAX)
    u, v = np.broadcast_arrays(*ideal_pixels(camera.optics))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    directions = rays @ camera.world_from_cam[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        on_table = camera.position[:2] - directions[..., :2] * (camera.position[2] / directions[..., 2:])
    row, column = np.moveaxis(((on_table - TABLE[:2]) / SIDE + 0.5) * RESOLUTION - 0.5, -1, 0).astype(np.float32)
    image = cv2.remap(spots, column, row, cv2.INTER_LINEAR, borderValue=128)
    image += noise * np.random.default_rng(seed).normal(size=image.shape)
    return np.repeat(image.clip(0, 255).astype(np.uint8)[..., None], 3, axis=-1)
