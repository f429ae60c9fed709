"""Poses whose file does not say how to read them: the reading with which the camera sees the workspace."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import product
from typing import Any

import numpy as np

from lerobot_symview.calibration.file import METRES, parse_calibration
from lerobot_symview.calibration.formats.facts import BASE_TO_CAMERA, CAMERA_TO_BASE, OPENGL, OPTICAL, ROS_LINK, Pose
from lerobot_symview.errors import CalibrationError, OptionError
from lerobot_symview.geometry.camera import Array, Camera
from lerobot_symview.geometry.visibility import AXES as NAMED_AXES
from lerobot_symview.geometry.visibility import camera_problem
from lerobot_symview.geometry.workspace import Workspace

logger = logging.getLogger(__name__)

DIRECTIONS, ORDERS = (CAMERA_TO_BASE, BASE_TO_CAMERA), ("xyzw", "wxyz")
AXES: dict[str, Array] = dict(zip((OPTICAL, OPENGL, ROS_LINK), NAMED_AXES.values(), strict=True))  # theirs_from_opencv
FARTHEST = 20.0  # metres from the base: a longer translation is in millimetres


@dataclass(frozen=True)
class PoseReading:
    """How to read a pose, in place of what its file says and of the reading that sees the workspace.

    Raises:
        OptionError: if a value is unknown.
    """

    direction: str | None = None
    """camera_to_base (the camera's pose in the base) or base_to_camera (its inverse)."""
    quaternion_order: str | None = None
    """xyzw or wxyz."""
    camera_axes: str | None = None
    """optical (OpenCV: x right, y down, z forward), ros_link (x forward, z up) or opengl (y up, z backward)."""
    unit: str | None = None
    """m or mm, of the translation."""

    def __post_init__(self) -> None:
        known = {"direction": DIRECTIONS, "quaternion_order": ORDERS, "camera_axes": tuple(AXES), "unit": tuple(METRES)}
        for entry in fields(self):
            value = getattr(self, entry.name)
            if value is not None and value not in known[entry.name]:
                expected = ", ".join(known[entry.name])
                raise OptionError(f"the pose's {entry.name} must be one of {expected}, got {value!r}")


class ReadingError(CalibrationError):
    """Several readings of a pose show the workspace, or none: a `PoseReading` decides."""


def readings(pose: Pose, reading: PoseReading) -> dict[str, dict[str, Any]]:
    """Return description -> entry of our own calibration file, in metres, for all readings that are not ruled out.

    A description names what the file does not say.
    """
    metres = _metres(pose, reading)
    orders: tuple[str | None, ...] = (None,)
    if pose.rotation.shape == (4,):
        orders = _possible(reading.quaternion_order or pose.quaternion_order, ORDERS)
    choices: tuple[tuple[Any, ...], ...] = (
        _possible(reading.direction or pose.direction, DIRECTIONS),
        _possible(reading.camera_axes or pose.axes, tuple(AXES)),
        orders,
    )
    found = {}
    for direction, axes, order in product(*choices):
        names = (direction, f"{axes} axes", f"quaternion {order}")
        unsaid = [name for name, values in zip(names, choices, strict=True) if len(values) > 1]
        matrix = np.eye(4)
        matrix[:3, :3] = _matrix(pose.rotation, order)
        matrix[:3, 3] = pose.translation * metres
        if direction == CAMERA_TO_BASE:
            matrix[:3, :3] = matrix[:3, :3] @ AXES[axes]
            found[", ".join(unsaid)] = {"world_from_cam": matrix.tolist()}
        else:
            found[", ".join(unsaid)] = {"cam_from_world": (_rigid(AXES[axes].T) @ matrix).tolist()}
    return found


def resolve(
    name: str, entries: Mapping[str, Any], pose: Pose, reading: PoseReading, workspace: Workspace | None
) -> dict[str, Any]:
    """Return the entry `world_from_cam` or `cam_from_world` of our own calibration file.

    Args:
        name: the camera's name.
        entries: its other entries in our own file: height, width and intrinsics.
        pose: what its file says.
        reading: what the user says.
        workspace: what the camera must see if the file leaves several readings.

    Raises:
        ReadingError: if not exactly one reading sees the workspace; the message lists what each of them sees.
    """
    possible = readings(pose, reading)
    if pose.metres is None and reading.unit is None and _metres(pose, reading) != METRES["m"]:
        logger.info("camera %r: its position, %s, is read as millimetres", name, pose.translation)
    if len(possible) == 1:
        return next(iter(possible.values()))
    cameras = {
        description: parse_calibration({"units": "m", "cameras": {name: {**entries, **entry}}}).camera(name)
        for description, entry in possible.items()
    }
    if workspace is None:
        raise ReadingError(f"camera {name!r}: the file does not say which pose it is: {'; '.join(possible)}")
    problems = {description: camera_problem(camera, workspace) for description, camera in cameras.items()}
    sound = [description for description, problem in problems.items() if problem is None]
    if sound and all(_same(cameras[sound[0]], cameras[other]) for other in sound):
        logger.info(
            "camera %r: pose read as %s, the only one of %d readings that sees the workspace",
            name,
            sound[0],
            len(possible),
        )
        return possible[sound[0]]
    listed = sound or sorted(cameras, key=lambda each: -workspace.visible_fraction(cameras[each]))
    seen = "; ".join(f"{each}: {problems[each] or _seen(cameras[each], workspace)}" for each in listed)
    count = f"{len(sound)} readings of its pose see" if sound else f"none of {len(possible)} readings of its pose sees"
    raise ReadingError(
        f"camera {name!r}: {count} the workspace of {workspace.size:g} m at {workspace.center}: {seen}; "
        "say which it is, or check the workspace"
    )


def _metres(pose: Pose, reading: PoseReading) -> float:
    """Return the metres per unit: of the reading, else of the file, else the unit with which the camera is near."""
    if reading.unit is not None:
        return METRES[reading.unit]
    near = np.linalg.norm(pose.translation) <= FARTHEST
    return pose.metres or (METRES["m"] if near else METRES["mm"])


def _possible(known: Any, all_values: tuple[Any, ...]) -> tuple[Any, ...]:
    return all_values if known is None else (known,)


def _matrix(rotation: Array, order: str | None) -> Array:
    if order is None:
        return rotation
    from scipy.spatial.transform import Rotation

    norm = np.linalg.norm(rotation)
    if not abs(norm - 1) < 0.01:
        raise CalibrationError(f"the quaternion must have length 1, got {norm:.3g}")
    matrix: Array = Rotation.from_quat(rotation, scalar_first=order == "wxyz").as_matrix()
    return matrix


def _rigid(rotation: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return matrix


def _same(first: Camera, second: Camera) -> bool:
    return np.allclose(first.world_from_cam, second.world_from_cam, atol=1e-3)


def _seen(camera: Camera, workspace: Workspace) -> str:
    x, y, z = camera.position
    return f"sees {workspace.visible_fraction(camera):.0%} of it from ({x:.2f}, {y:.2f}, {z:.2f})"
