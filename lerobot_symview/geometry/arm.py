"""Removal of the arm over the gripper, and of it alone, from a depth image."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Camera, ideal_pixels
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.geometry.zbuffer import grid_from_pixel


def without_arm(
    depth: NDArray[np.floating],
    camera: Camera,
    workspace: Workspace,
    gripper: NDArray[np.floating],
    radius: float,
    ceiling: float,
) -> NDArray[np.floating]:
    """Return a depth image without the points above the gripper, and above the working volume elsewhere.

    An arm that reaches down from above is over the gripper; objects beside it may be higher than the gripper.

    Args:
        depth: (H, W) float, metres along the optical axis.
        camera: its calibration.
        workspace: the working volume.
        gripper: x and y come first, metres, relative to the workspace's centre.
        radius: horizontal distance from the gripper within which points above `ceiling` are removed, metres.
        ceiling: metres above the table.

    Returns:
        (H, W), same dtype; 0 where a point is removed.
    """
    cells = grid_from_pixel(camera, workspace, 1)  # rows and columns of the workspace's square, as one cell
    u, v = np.broadcast_arrays(*ideal_pixels(camera.optics))
    kept = np.array(depth)
    place = np.asarray(gripper[:2], dtype=np.float64) / workspace.size + 0.5
    _remove(kept, u, v, *cells, place, (radius / workspace.size) ** 2, ceiling, workspace.height_limit)
    return kept


@njit(cache=True, nogil=True)
def _remove(depth, us, vs, rays, origin, place, radius_squared, ceiling, highest):  # type: ignore[no-untyped-def]
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            distance, u, v = np.float64(depth[i, j]), us[i, j], vs[i, j]
            if distance > 0.0 and distance < np.inf:
                z = origin[2] + distance * (rays[2, 0] * u + (rays[2, 1] * v + rays[2, 2]))
                if z > ceiling:
                    row = origin[0] + distance * (rays[0, 0] * u + (rays[0, 1] * v + rays[0, 2])) - place[0]
                    column = origin[1] + distance * (rays[1, 0] * u + (rays[1, 1] * v + rays[1, 2])) - place[1]
                    if z > highest or row * row + column * column <= radius_squared:
                        depth[i, j] = 0.0
