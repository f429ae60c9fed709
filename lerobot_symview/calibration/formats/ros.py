"""ROS: camera_info, easy_handeye, easy_handeye2, and a transform in a parameter file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lerobot_symview.calibration.formats.document import Document
from lerobot_symview.calibration.formats.facts import (
    CAMERA_TO_BASE,
    CameraFacts,
    Facts,
    Format,
    Pose,
    Size,
    frame_axes,
    intrinsics_matrix,
    lens,
    numbers,
    optional_size,
    pose_between,
)
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Array
from lerobot_symview.geometry.lens import EQUIDISTANT, PLUMB_BOB

MODELS = {"radtan": PLUMB_BOB, "fisheye": EQUIDISTANT, "": None}


def _is_camera_info(document: Document) -> bool:
    entries = document.entries()
    matrix = entries.get("camera_matrix")
    has_lens = bool({"distortion_model", "distortion_coefficients", "projection_matrix"} & set(entries))
    in_file = isinstance(matrix, Mapping) and "data" in matrix
    return has_lens and (in_file or bool({"K", "k"} & set(entries)))


def _camera_info(document: Document, size: Size | None) -> Facts:
    """A file of camera_calibration, or an echoed message sensor_msgs/CameraInfo."""
    entries = document.entries()
    if "camera_matrix" in entries:
        named, height, width = ("camera_matrix", "distortion_coefficients"), "image_height", "image_width"
    else:
        named, height, width = ("K", "D") if "K" in entries else ("k", "d"), "height", "width"
    matrix, distortion = (_data(entries.get(name)) for name in named)
    model = str(entries.get("distortion_model") or "")
    facts = CameraFacts(
        intrinsics_matrix(named[0], matrix),
        optional_size(entries, height, width),
        **lens(MODELS.get(model, model), [] if distortion is None else distortion),
    )
    return {str(entries.get("camera_name") or ""): facts}


def _data(entry: Any) -> Any:
    return entry.get("data") if isinstance(entry, Mapping) else entry


def _is_handeye(document: Document) -> bool:
    entries = document.entries()
    transform, parameters = entries.get("transform"), entries.get("parameters")
    return isinstance(transform, Mapping) and "rotation" in transform and isinstance(parameters, Mapping)


def _handeye2(document: Document, size: Size | None) -> Facts:
    entries = document.entries()
    parameters, transform = entries["parameters"], entries["transform"]
    if parameters.get("calibration_type") not in ("eye_on_base", None):
        raise _on_hand(parameters["calibration_type"])
    rotation, translation = _xyzw(transform["rotation"]), _xyz(transform["translation"])
    return {"": CameraFacts(pose=_base_from_camera(parameters, rotation, translation))}


def _is_handeye1(document: Document) -> bool:
    transformation = document.entries().get("transformation")
    return isinstance(transformation, Mapping) and "qw" in transformation


def _handeye1(document: Document, size: Size | None) -> Facts:
    entries = document.entries()
    parameters, transformation = entries.get("parameters") or {}, entries["transformation"]
    if parameters.get("eye_on_hand", entries.get("eye_on_hand", False)):
        raise _on_hand("eye_on_hand: true")
    rotation = numbers("qx, qy, qz, qw", [transformation.get(f"q{axis}") for axis in "xyzw"], 4)
    return {"": CameraFacts(pose=_base_from_camera(parameters | entries, rotation, _xyz(transformation)))}


def _base_from_camera(parameters: Mapping[str, Any], rotation: Array, translation: Array) -> Pose:
    axes = frame_axes(str(parameters.get("tracking_base_frame", "")))
    return Pose(rotation, translation, CAMERA_TO_BASE, axes, "xyzw", 1.0)


def _on_hand(kind: Any) -> CalibrationError:
    return CalibrationError(f"the camera is on the robot's hand ({kind}), expected one that stands beside the table")


def _is_transform(document: Document) -> bool:
    entries = document.entries()
    return {"translation", "rotation"} <= set(entries) and bool(
        {"parent_frame", "child_frame", "frame_id", "child_frame_id"} & set(entries)
    )


def _transform(document: Document, size: Size | None) -> Facts:
    """A transform parent_from_child, as for static_transform_publisher."""
    entries = document.entries()
    parent = str(entries.get("parent_frame", entries.get("frame_id", "")))
    child = str(entries.get("child_frame", entries.get("child_frame_id", "")))
    rotation, translation = _xyzw(entries["rotation"]), _xyz(entries["translation"])
    return {"": CameraFacts(pose=pose_between(parent, child, rotation, translation))}


def _xyzw(entry: Any) -> Array:
    value = [entry.get(axis) for axis in "xyzw"] if isinstance(entry, Mapping) else entry
    return numbers("rotation x, y, z, w", value, 4)


def _xyz(entry: Any) -> Array:
    value = [entry.get(axis) for axis in "xyz"] if isinstance(entry, Mapping) else entry
    return numbers("translation x, y, z", value, 3)


CAMERA_INFO = Format("ROS camera_info", _is_camera_info, _camera_info)
EASY_HANDEYE2 = Format("easy_handeye2", _is_handeye, _handeye2)
EASY_HANDEYE = Format("easy_handeye", _is_handeye1, _handeye1)
TRANSFORM = Format("ROS transform", _is_transform, _transform)
