"""Which part of the workspace a camera sees past the robot arm, and placements from which it sees enough."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.placement import TRIES, CameraSpec
from lerobot_symview.geometry.visibility import table_rays
from lerobot_symview.geometry.workspace import Workspace
from symview_sim.lens import through_lens
from symview_sim.rendering import render

LEAST_SEEN = 0.3  # fraction of the workspace: a camera that sees less shows the arm and makes empty views
ROBOT = 1  # label in a segmentation image
PIXELS = 96  # rows and columns of the image in which the arm is looked for


def place_in_sight(
    spec: CameraSpec, client: Any, workspace: Workspace, rng: np.random.Generator | None = None
) -> Camera:
    """Return the camera that `spec` describes, past the arm; with `rng` and a spread, the first such placement.

    Args:
        spec: the camera.
        client: PyBullet client of the scene, the arm at its start.
        workspace: the square on the table that the camera must see.
        rng: as for `CameraSpec.place`.

    Raises:
        CalibrationError: if the arm hides more than 70 % of the workspace from the camera, or from each of 100
            placements, or as `CameraSpec.place` does.
    """
    seen = 0.0
    for _ in range(TRIES if rng is not None and spec.varies else 1):
        camera = spec.place(workspace, rng)
        if not spec.sees_robot:
            return camera
        seen = seen_fraction(client, camera, workspace)
        if seen >= LEAST_SEEN:
            return camera
    raise CalibrationError(
        f"camera {spec.name!r}: the arm hides {1 - seen:.0%} of the workspace, at most {1 - LEAST_SEEN:.0%} may be "
        f"hidden: change azimuth_deg (got {spec.azimuth_deg:g}) or elevation_deg (got {spec.elevation_deg:g})"
    )


def seen_fraction(client: Any, camera: Camera, workspace: Workspace) -> float:
    """Return the fraction of the workspace's pixels in a camera's image that do not show the robot; 0 without any."""
    camera = camera.resized(PIXELS)
    _, _, inside = table_rays(camera, workspace)
    labels = through_lens(partial(render, client, labelled=True), camera).labels
    assert labels is not None
    return float((labels[inside] != ROBOT).mean()) if inside.any() else 0.0
