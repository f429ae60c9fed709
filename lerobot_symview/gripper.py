"""The gripper as seen from above: two finger squares whose value is the gripper's height (paper Figure 11)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import array_api_compat
import numpy as np
from numpy.typing import NDArray

from lerobot_symview.workspace import Workspace


@dataclass(frozen=True)
class GripperShape:
    """How a parallel gripper is drawn.

    Args:
        opening: distance between the fingers' inner faces at aperture 1, metres.
        finger: side of the square that stands for a finger, metres.
    """

    opening: float = 0.08
    finger: float = 0.024


def gripper_image(state: Any, workspace: Workspace, pixels: int, shape: GripperShape | None = None) -> Any:
    """Draw the gripper of each state into a top-down image.

    Args:
        state: (..., 5) float numpy array or torch tensor: x, y (metres, relative to the workspace centre), z (metres),
            yaw (radians; at 0 the fingers open along x), aperture in [0, 1].
        workspace: what the image covers.
        pixels: side of the image.
        shape: the gripper's dimensions.

    Returns:
        (..., pixels, pixels), same kind and dtype as `state`: z / workspace.height_limit inside a finger, 0 outside. A
        finger's border pixels are covered in part, so the picture moves smoothly with the gripper; it turns and
        mirrors exactly with the state, by any angle.
    """
    xp = array_api_compat.array_namespace(state)
    centers = ((xp.arange(pixels, dtype=state.dtype, device=array_api_compat.device(state)) + 0.5) / pixels - 0.5) * (
        workspace.size
    )
    return _draw(state, centers, centers, workspace, workspace.size / pixels, shape or GripperShape())


def gripper_picture(
    state: NDArray[np.floating], workspace: Workspace, pixels: int, shape: GripperShape | None = None
) -> NDArray[np.uint8]:
    """Draw the gripper of one state (5,) as `gripper_image` does, in grey levels: (pixels, pixels) uint8, 255 = 1.

    Only the square that the gripper can fill is computed.
    """
    shape = shape or GripperShape()
    state = np.asarray(state, dtype=np.float64)
    resolution = workspace.size / pixels
    reach = np.hypot(max(state[4], 0.0) * shape.opening / 2 + shape.finger, shape.finger / 2) + resolution
    spans = []
    for center in state[:2]:
        first, last = (center + np.array([-reach, reach])) / resolution + pixels / 2
        spans.append(slice(*np.clip([np.floor(first), np.ceil(last)], 0, pixels).astype(int)))
    centers = ((np.arange(pixels) + 0.5) / pixels - 0.5) * workspace.size
    picture = np.zeros((pixels, pixels), dtype=np.uint8)
    drawn = _draw(state, centers[spans[0]], centers[spans[1]], workspace, resolution, shape)
    picture[spans[0], spans[1]] = np.rint(255 * np.clip(drawn, 0.0, 1.0))
    return picture


def _draw(state: Any, rows: Any, columns: Any, workspace: Workspace, resolution: float, shape: GripperShape) -> Any:
    """Draw at the pixels whose centres lie at `rows` (R,) and `columns` (C,) metres: (..., R, C)."""
    xp = array_api_compat.array_namespace(state)
    x, y, z, yaw, aperture = (state[..., i, None, None] for i in range(5))
    forward = rows[:, None] - x
    sideward = columns[None, :] - y
    along = xp.abs(forward * xp.cos(yaw) + sideward * xp.sin(yaw))  # a finger stands on either side: |.| draws both
    across = xp.abs(sideward * xp.cos(yaw) - forward * xp.sin(yaw))
    finger_center = (aperture * shape.opening + shape.finger) / 2
    coverage = _ramp(xp, xp.abs(along - finger_center), shape, resolution) * _ramp(xp, across, shape, resolution)
    return coverage * z / workspace.height_limit


def _ramp(xp: Any, distance: Any, shape: GripperShape, resolution: float) -> Any:
    return xp.clip((shape.finger / 2 - distance) / resolution + 0.5, 0.0, 1.0)
