"""Whether a camera sees the workspace, and which other reading of its pose would explain that it does not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Array, Camera, ideal_pixels, invert_rigid, project
from lerobot_symview.geometry.workspace import Workspace

MILLIMETRE = 0.001  # metres
LATTICE = 9  # points per side of the workspace where the camera's resolution is measured
MINIMUM_VISIBLE = 0.6  # fraction of the working volume
LEAST_VISIBLE = 0.1  # a camera that sees less, fixed or moving, makes empty views
MINIMUM_PIXELS = 8.0  # side of the workspace in the image, as of the smallest view
BELOW_TABLE = (
    "usual causes are board corners in the wrong order (OpenCV orders them clockwise, seen from above: exchange x and "
    "y) and a pose that is the inverse, cam_from_world"
)
# What people pass in place of world_from_cam. The matrices are theirs_from_opencv.
AXES = {
    "": np.eye(3),
    "OpenGL axes (y up, z backward)": np.diag([1.0, -1.0, -1.0]),
    "ROS link axes (x forward, z up)": np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
}
DIRECTIONS = {"": False, "the direction cam_from_world": True}
UNITS = {"": 1.0, "a position in millimetres": 1e-3, "a position in centimetres": 1e-2, "a position in metres": 1e3}


def check_above_table(camera: Camera) -> None:
    """Raise a CalibrationError if a camera is not above the table's plane, z = 0: its views would be reflected."""
    if not camera.world_from_cam[2, 3] > 0:
        raise CalibrationError(f"the camera is below the table, at z = {camera.position[2]:.3g} m: {BELOW_TABLE}")


def check_camera(
    name: str,
    camera: Camera,
    workspace: Workspace,
    remedy: str = "",
    minimum: float = MINIMUM_VISIBLE,
    pixels: float = MINIMUM_PIXELS,
) -> None:
    """Raise an error unless a camera above the table shows enough of the workspace in enough pixels.

    Args:
        name: the camera's name in the message.
        camera: the calibrated camera.
        workspace: the working volume.
        remedy: end of the message; by default the other readings of the pose with which the camera would be sound.
        minimum: fraction of the working volume that must be in the image.
        pixels: side of the workspace in the image that is needed, `workspace_pixels`.

    Raises:
        CalibrationError: if the camera is below the table, sees too little of the workspace, or is too far away.
    """
    problem = camera_problem(camera, workspace, minimum, pixels)
    if problem is not None:
        raise CalibrationError(f"camera {name!r} {problem}: {remedy or _causes(camera, workspace)}")


def _causes(camera: Camera, workspace: Workspace) -> str:
    readings = sound_readings(camera, workspace)
    causes = [BELOW_TABLE] if camera.position[2] <= 0 else ["check its pose and the workspace"]
    causes += ["it would see the workspace with " + " or with ".join(readings)] if readings else []
    return "; ".join(causes)


def camera_problem(
    camera: Camera, workspace: Workspace, minimum: float = MINIMUM_VISIBLE, pixels: float = MINIMUM_PIXELS
) -> str | None:
    """Return what is wrong with a camera that must see the workspace, as `check_camera` says; None if nothing is."""
    if not camera.position[2] > 0:
        return f"is below the table, at z = {camera.position[2]:.3g} m"
    visible = workspace.visible_fraction(camera)
    if visible < minimum:
        return f"sees {visible:.0%} of the workspace, expected at least {minimum:.0%}"
    side = workspace_pixels(camera, workspace)
    if side < pixels:
        return (
            f"shows the workspace in {side:.2g} x {side:.2g} pixels, expected at least {pixels:.0f}; "
            f"it is {np.linalg.norm(camera.position - [*workspace.center, 0]):.3g} m away"
        )
    return None


def table_rays(camera: Camera, workspace: Workspace, step: int = 1) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the rays of every `step`-th pixel of an image, and which of them meet the workspace's square on z = 0.

    Args:
        camera: gives the image's size.
        workspace: the square.
        step: rows and columns from one pixel to the next.

    Returns:
        (h, w, 3) world directions of depth 1; (h, w) depth at which they meet the table, metres; (h, w) whether they
        meet the square.
    """
    u, v = (plane[::step, ::step] for plane in np.broadcast_arrays(*ideal_pixels(camera.optics)))
    in_camera = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    directions = in_camera @ camera.world_from_cam[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -camera.position[2] / directions[..., 2]
        offset = camera.position[:2] + depth[..., None] * directions[..., :2] - workspace.center
        inside = (directions[..., 2] < 0) & (np.abs(offset) <= workspace.size / 2).all(axis=-1)
    return directions, depth, inside


def workspace_pixels(camera: Camera, workspace: Workspace) -> float:
    """Return the side, in pixels, of a square with the area of the workspace in the image.

    It is infinite if a corner of the workspace is behind the camera.
    """
    corners, depth = project(workspace.corners(), camera)
    if (depth <= 0).any():
        return np.inf
    following = np.roll(corners, -1, axis=0)
    area = (corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]).sum() / 2
    return float(np.sqrt(abs(area)))


def read_differently(camera: Camera) -> dict[tuple[str, ...], Camera]:
    """Return changes -> the camera with its pose read with these changes, those with fewest changes first."""
    readings = {}
    for (axes, theirs_from_opencv), (direction, inverse), (unit, metres) in product(
        AXES.items(), DIRECTIONS.items(), UNITS.items()
    ):
        pose = _scaled(camera.world_from_cam, metres)
        pose = invert_rigid(pose) if inverse else pose
        pose[:3, :3] = pose[:3, :3] @ theirs_from_opencv
        changes = tuple(change for change in (direction, unit, axes) if change)
        readings[changes] = replace(camera, world_from_cam=pose)
    return {changes: readings[changes] for changes in sorted(readings, key=len) if changes}


def sound_readings(camera: Camera, workspace: Workspace) -> list[str]:
    """Return the descriptions of the simplest other readings of a pose with which the camera sees the workspace."""
    sound = [changes for changes, other in read_differently(camera).items() if camera_problem(other, workspace) is None]
    return [" and ".join(changes) for changes in sound if len(changes) == len(sound[0])]


def _scaled(pose: Array, metres: float) -> Array:
    scaled = pose.copy()
    scaled[:3, 3] *= metres
    return scaled


def table_resolution(camera: Camera, workspace: Workspace) -> float:
    """Return the camera's lowest resolution on the table, over points and directions, pixels per millimetre.

    It is zero if a part of the workspace lies behind the camera.
    """
    steps = np.linspace(0.5 / LATTICE, 1 - 0.5 / LATTICE, LATTICE) * workspace.size - workspace.size / 2
    x, y = np.meshgrid(steps + workspace.center[0], steps + workspace.center[1])
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    here, depth = project(points, camera)
    if (depth <= 0).any():
        return 0.0
    moved = [project(points + step, camera)[0] - here for step in np.eye(3)[:2] * MILLIMETRE]
    return float(np.linalg.svd(np.stack(moved, axis=-1), compute_uv=False)[:, -1].min())


def detail(name: str, camera: Camera, workspace: Workspace, sizes: Mapping[str, int]) -> str:
    """Return how finely a camera shows the table, in words, beside the sizes of the views that are made of it.

    Args:
        name: the camera's name.
        camera: the calibrated camera.
        workspace: the square on the table that the views show.
        sizes: rows of each view, by its name.
    """
    side = workspace_pixels(camera, workspace)
    if side == np.inf:
        return f"camera {name!r} has a corner of the workspace behind it"
    mean, worst = side * MILLIMETRE / workspace.size, table_resolution(camera, workspace)
    drawn = ", ".join(f"{view} has {size}" for view, size in sizes.items())
    return (
        f"camera {name!r} has {mean:.2g} pixels a millimetre on the table, at worst {worst:.2g}: it fills a view of "
        f"{side:.0f} x {side:.0f} pixels, {drawn}"
    )
