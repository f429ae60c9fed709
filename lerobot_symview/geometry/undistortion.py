"""A camera's image without the distortion of its lens."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Camera, from_ideal


def undistorted(image: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
    """Return the image that a pinhole camera with the same K, size and pose would take, interpolated linearly.

    What lies beyond its field of view, such as the border of a fisheye's image, is cut off; what the lens does not show
    is black.

    Args:
        image: (H, W) or (H, W, 3) uint8, of the camera.
        camera: its calibration; the pose does not matter.
    """
    if camera.lens is None:
        return image
    ideal = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).astype(np.float64)
    u, v = np.moveaxis(from_ideal(ideal, camera), -1, 0).astype(np.float32)
    seen: NDArray[np.uint8] = cv2.remap(image, u, v, cv2.INTER_LINEAR)
    return seen
