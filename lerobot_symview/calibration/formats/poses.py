"""Poses in JSON, YAML, text and NumPy files: DROID, matrices, position and quaternion, rotation and translation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_symview.calibration.formats.document import Document
from lerobot_symview.calibration.formats.facts import (
    BASE_TO_CAMERA,
    CAMERA_TO_BASE,
    OPTICAL,
    CameraFacts,
    Facts,
    Format,
    Pose,
    Size,
    count,
    intrinsics_matrix,
    matrix_pose,
    numbers,
    optional_size,
    pinhole,
)
from lerobot_symview.errors import CalibrationError

DIRECTIONS = {"transform_camera_to_world": CAMERA_TO_BASE, "transform_world_to_camera": BASE_TO_CAMERA}
TRANSLATIONS = ("translation_vector", "translation")


def _has_droid(entries: Mapping[str, Any]) -> bool:
    return count(entries.get("pose")) == 6


def _droid(document: Document, size: Size | None) -> Facts:
    """`pose`: x, y, z in metres and extrinsic Euler angles x, y, z in radians, from the camera to the robot's base."""
    facts = {}
    for name, entries in document.cameras(_has_droid).items():
        x, y, z, *angles = numbers("pose", entries["pose"], 6)
        rotation = Rotation.from_euler("xyz", angles).as_matrix()
        facts[name] = CameraFacts(pose=Pose(rotation, np.array([x, y, z]), CAMERA_TO_BASE, OPTICAL, None, 1.0))
    return facts


def _has_transform(entries: Mapping[str, Any]) -> bool:
    return bool(set(DIRECTIONS) & set(entries))


def _transform(document: Document, size: Size | None) -> Facts:
    """`transform_camera_to_world` with `intrinsics` beside it; other copies of the matrix are not read."""
    facts = {}
    for name, entries in document.cameras(_has_transform).items():
        key = next(key for key in DIRECTIONS if key in entries)
        pose = matrix_pose(key, entries[key], DIRECTIONS[key], metres=1.0)
        intrinsics, values = None, entries.get("intrinsics")
        if isinstance(values, Mapping):
            intrinsics = pinhole(*(values.get(entry) for entry in ("fx", "fy", "cx", "cy")))
        shape = optional_size(values) if isinstance(values, Mapping) else None
        facts[name] = CameraFacts(intrinsics, shape or optional_size(entries), pose=pose)
    return facts


def _has_quaternion(entries: Mapping[str, Any]) -> bool:
    return {"pos", "quat"} <= set(entries)


def _quaternion(document: Document, size: Size | None) -> Facts:
    facts = {}
    for name, entries in document.cameras(_has_quaternion).items():
        direction = CAMERA_TO_BASE if "base_frame_id" in entries else None
        rotation, translation = numbers("quat", entries["quat"], 4), numbers("pos", entries["pos"], 3)
        facts[name] = CameraFacts(pose=Pose(rotation, translation, direction))
    return facts


def _has_rotation(entries: Mapping[str, Any]) -> bool:
    return "rotation_matrix" in entries and any(name in entries for name in TRANSLATIONS)


def _rotation(document: Document, size: Size | None) -> Facts:
    facts = {}
    for name, entries in document.cameras(_has_rotation).items():
        key = next(key for key in TRANSLATIONS if key in entries)
        rotation = numbers("rotation_matrix", entries["rotation_matrix"], 3, 3)
        facts[name] = CameraFacts(pose=Pose(rotation, numbers(key, entries[key], 3)))
    return facts


def _is_array(document: Document) -> bool:
    """Whether all of a file is a list of numbers, or a table of numbers in text."""
    if isinstance(document.content, list):
        return count(document.content) > 0
    if isinstance(document.content, Mapping):
        return False
    return bool(document.text.strip()) and all(_is_number(word) for word in _words(document.text))


def _array(document: Document, size: Size | None) -> Facts:
    """`np.savetxt`, `np.save`: a pose 4 x 4 or 3 x 4, or K 3 x 3."""
    value = document.content if isinstance(document.content, list) else [float(word) for word in _words(document.text)]
    if count(value) == 9:
        matrix = intrinsics_matrix("K", value)
        if not np.array_equal(matrix[2], [0, 0, 1]):
            raise CalibrationError(f"a 3 x 3 matrix must be K, with the last row 0 0 1, got {matrix[2]}")
        return {"": CameraFacts(matrix)}
    if count(value) in (12, 16):
        return {"": CameraFacts(pose=matrix_pose("the matrix", value))}
    raise CalibrationError(f"expected a pose of 4 x 4 or 3 x 4 numbers, or K of 3 x 3, got {count(value)} numbers")


def _words(text: str) -> list[str]:
    lines = (line.partition("#")[0] for line in text.splitlines())
    return " ".join(lines).replace(",", " ").replace(";", " ").split()


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _recogniser(has: Callable[[Mapping[str, Any]], bool]) -> Callable[[Document], bool]:
    return lambda document: bool(document.cameras(has))


DROID = Format("DROID", _recogniser(_has_droid), _droid)
CAMERA_TO_WORLD = Format("transform_camera_to_world JSON", _recogniser(_has_transform), _transform)
POS_QUAT = Format("pos and quat JSON", _recogniser(_has_quaternion), _quaternion)
ROTATION_TRANSLATION = Format("rotation_matrix and translation_vector JSON", _recogniser(_has_rotation), _rotation)
ARRAY = Format("matrix in text or NumPy's files", _is_array, _array)
