"""Memory of a reprojected image: what a cell showed when it was last seen, for cells that something hides now."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.occlusion import SEE_THROUGH, image_from_grid, measured_at, pinhole_depth
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.geometry.zbuffer import EMPTY, ZBuffer

FORGOTTEN = -1  # age of cells that show nothing that is remembered
GRIPPER_RADIUS = 0.06  # metres: fingers that are 8 cm apart, and what moves with them
GRIPPER_DEPTH = 0.03  # metres that fingers, and what they hold, reach below the gripper's position


class Memory(NamedTuple):
    """What the cells of an image showed when they were last seen.

    Attributes:
        rgb: (P, P, 3) uint8.
        height: (P, P) float32, metres above the table.
        age: (P, P) int32, frames since; -1 where nothing is remembered.
    """

    rgb: NDArray[np.uint8]
    height: NDArray[np.float32]
    age: NDArray[np.int32]


def recall(
    memory: Memory | None,
    buffer: ZBuffer,
    depths: list[NDArray[np.floating]],
    cameras: list[Camera],
    workspace: Workspace,
    gripper: NDArray[np.floating] | None = None,
) -> tuple[ZBuffer, NDArray[np.int32]]:
    """Add to a z-buffer the remembered cells that are hidden now.

    A cell without a point is hidden if every camera measures something before its remembered point, or nothing. Where
    a camera looks at the point, the cell is infilled as its neighbours are; where it looks through the point, nothing
    is there any more. What is within 6 cm of the gripper is forgotten if the fingers reach down to it: it may have been
    moved.

    Args:
        memory: of the frames before; None at the start of an episode.
        buffer: (P, P), the points of this frame.
        depths: (H, W) of each camera, metres along the optical axis, the arm included; others than positive finite
            numbers are invalid.
        cameras: calibrated camera of each depth image.
        workspace: the square on the table that the image shows.
        gripper: (5,) x, y (metres, relative to the workspace centre), z (metres), yaw, aperture; None if unknown.

    Returns:
        The buffer, whose recalled cells have as sources the pixels of `memory.rgb`, counted after those of all cameras;
        and (P, P) int32, the age of each cell as in `Memory`.
    """
    seen = buffer.source != EMPTY
    if memory is None:
        return buffer, np.where(seen, 0, FORGOTTEN).astype(np.int32)
    pixels, cell = len(seen), workspace.size / len(seen)
    hidden = np.zeros_like(seen)
    row, column, lowest = 0.0, 0.0, np.inf
    if gripper is not None:
        row, column = (float(gripper[axis]) / cell + pixels / 2 for axis in (0, 1))
        lowest = float(gripper[2]) - GRIPPER_DEPTH
    _remembered(hidden, buffer.source, memory.height, memory.age, row, column, GRIPPER_RADIUS / cell, lowest)
    for depth, camera in zip(depths, cameras, strict=True):
        _keep_hidden(hidden, memory.height, pinhole_depth(depth, camera), image_from_grid(camera, workspace, pixels))
    merged, age = ZBuffer(buffer.height.copy(), buffer.source.copy()), np.empty_like(memory.age)
    _merge(hidden, memory.height, memory.age, sum(camera.height * camera.width for camera in cameras), *merged, age)
    return merged, age


@njit(cache=True, nogil=True)
def _remembered(hidden, sources, heights, ages, row, column, radius, lowest):  # type: ignore[no-untyped-def]
    side = hidden.shape[0]
    for i in range(side):
        for j in range(side):
            if sources[i, j] < 0 and ages[i, j] >= 0:
                is_near = (i + 0.5 - row) ** 2 + (j + 0.5 - column) ** 2 <= radius**2
                hidden[i, j] = not (is_near and heights[i, j] >= lowest)


@njit(cache=True, nogil=True)
def _keep_hidden(hidden, heights, depth, matrix):  # type: ignore[no-untyped-def]
    side = hidden.shape[0]
    for i in range(side):
        for j in range(side):
            if hidden[i, j]:
                distance, measured = measured_at(depth, matrix, i + 0.5, j + 0.5, heights[i, j])
                hidden[i, j] = not (measured < np.inf and measured > 0.0 and measured >= distance - SEE_THROUGH)


@njit(cache=True, nogil=True)
def _merge(hidden, heights, ages, first, height, source, age):  # type: ignore[no-untyped-def]
    side = hidden.shape[0]
    for i in range(side):
        for j in range(side):
            age[i, j] = 0 if source[i, j] >= 0 else -1
            if hidden[i, j]:
                height[i, j], source[i, j] = heights[i, j], first + i * side + j
                age[i, j] = ages[i, j] + 1
