"""The gripper as seen from above: two finger squares whose value is the gripper's height (paper Figure 11)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import array_api_compat

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
    shape = shape or GripperShape()
    xp = array_api_compat.array_namespace(state)
    device = array_api_compat.device(state)
    centers = ((xp.arange(pixels, dtype=state.dtype, device=device) + 0.5) / pixels - 0.5) * workspace.size
    x, y, z, yaw, aperture = (state[..., i, None, None] for i in range(5))
    forward = centers[:, None] - x
    sideward = centers[None, :] - y
    along = xp.abs(forward * xp.cos(yaw) + sideward * xp.sin(yaw))  # a finger stands on either side: |.| draws both
    across = xp.abs(sideward * xp.cos(yaw) - forward * xp.sin(yaw))
    resolution = workspace.size / pixels
    finger_center = (aperture * shape.opening + shape.finger) / 2
    coverage = _ramp(xp, xp.abs(along - finger_center), shape, resolution) * _ramp(xp, across, shape, resolution)
    return coverage * z / workspace.height_limit


def _ramp(xp: Any, distance: Any, shape: GripperShape, resolution: float) -> Any:
    return xp.clip((shape.finger / 2 - distance) / resolution + 0.5, 0.0, 1.0)
