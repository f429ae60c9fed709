"""Top-down gripper image: two squares for the fingers, with the gripper's height as value (paper Figure 11)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import array_api_compat
import numpy as np
from numba import njit
from numpy.typing import NDArray

from lerobot_symview.geometry.workspace import Workspace


@dataclass(frozen=True)
class GripperShape:
    """Dimensions of a parallel gripper in the gripper image.

    Args:
        opening: distance between the fingers' inner faces at aperture 1, metres.
        finger: side of the square that represents a finger, metres.
    """

    opening: float = 0.08
    finger: float = 0.024

    def reach(self, aperture: Any) -> Any:
        """Return the distance of the fingers' centres from the gripper's, metres, at an aperture in [0, 1]."""
        return (aperture * self.opening + self.finger) / 2


def gripper_image(state: Any, workspace: Workspace, pixels: int, shape: GripperShape | None = None) -> Any:
    """Draw the gripper of each state as a top-down image.

    Args:
        state: (..., 5) float numpy array or torch tensor: x, y (metres, relative to the workspace centre), z (metres),
            yaw (radians; at 0 the fingers open along x), aperture in [0, 1].
        workspace: the square on the table that the image covers.
        pixels: rows and columns of the image.
        shape: the gripper's dimensions.

    Returns:
        (..., pixels, pixels), same array type and dtype as `state`: z / workspace.height_limit inside a finger, 0
        outside. A finger's border pixels are antialiased, so the image changes smoothly with the gripper's pose.
        Rotating or reflecting the state, by any angle, is equivalent to drawing the rotated or reflected fingers.
    """
    return gripper_coverage(state, workspace, pixels, shape) * state[..., 2, None, None] / workspace.height_limit


def gripper_coverage(state: Any, workspace: Workspace, pixels: int, shape: GripperShape | None = None) -> Any:
    """Return which part of each pixel the fingers cover, as `gripper_image` draws them: (..., pixels, pixels)."""
    shape = shape or GripperShape()
    xp = array_api_compat.array_namespace(state)
    device = array_api_compat.device(state)
    centers = ((xp.arange(pixels, dtype=state.dtype, device=device) + 0.5) / pixels - 0.5) * workspace.size
    x, y, _, yaw, aperture = (state[..., i, None, None] for i in range(5))
    forward = centers[:, None] - x
    sideward = centers[None, :] - y
    along = xp.abs(forward * xp.cos(yaw) + sideward * xp.sin(yaw))  # the fingers are symmetric: |.| draws both
    across = xp.abs(sideward * xp.cos(yaw) - forward * xp.sin(yaw))
    resolution = workspace.size / pixels
    return ramp(xp, xp.abs(along - shape.reach(aperture)), shape, resolution) * ramp(xp, across, shape, resolution)


def gripper_image_uint8(
    state: NDArray[np.floating], workspace: Workspace, pixels: int, shape: GripperShape | None = None
) -> NDArray[np.uint8]:
    """Draw the gripper of one state (5,) as `gripper_image` does, as grey levels: (pixels, pixels) uint8, 255 = 1.

    Only pixels within the gripper's bounding square are computed.
    """
    shape = shape or GripperShape()
    x, y, z, yaw, aperture = np.asarray(state, dtype=np.float64).tolist()
    resolution = workspace.size / pixels
    reach = math.hypot(max(aperture, 0.0) * shape.opening / 2 + shape.finger, shape.finger / 2) + resolution
    spans = []
    for center in (x, y):
        first, last = (center - reach) / resolution + pixels / 2, (center + reach) / resolution + pixels / 2
        spans.append((max(math.floor(first), 0), min(math.ceil(last), pixels)))
    image = np.zeros((pixels, pixels), dtype=np.uint8)
    pose = (x, y, math.cos(yaw), math.sin(yaw), shape.reach(aperture), shape.finger / 2)
    _paint(image, spans[0], spans[1], workspace.size, pose, z / workspace.height_limit)
    return image


@njit(cache=True, nogil=True)
def _paint(image, rows, columns, size, pose, brightness):  # type: ignore[no-untyped-def]
    """Compute `gripper_image` pixel by pixel within the given rows and columns."""
    pixels = image.shape[0]
    resolution = size / pixels
    x, y, cos, sin, finger_center, half = pose
    for i in range(rows[0], rows[1]):
        forward = ((i + 0.5) / pixels - 0.5) * size - x
        for j in range(columns[0], columns[1]):
            sideward = ((j + 0.5) / pixels - 0.5) * size - y
            along = abs(forward * cos + sideward * sin)
            across = abs(sideward * cos - forward * sin)
            inside = min(max((half - abs(along - finger_center)) / resolution + 0.5, 0.0), 1.0)
            beside = min(max((half - across) / resolution + 0.5, 0.0), 1.0)
            image[i, j] = np.rint(255 * min(max(inside * beside * brightness, 0.0), 1.0))


def ramp(xp: Any, distance: Any, shape: GripperShape, resolution: float) -> Any:
    """Return which part of a pixel, at a distance from a finger's centre along an axis, the finger covers."""
    return xp.clip((shape.finger / 2 - distance) / resolution + 0.5, 0.0, 1.0)
