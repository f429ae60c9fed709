"""OpenCV: FileStorage in YAML, XML and JSON; K and lens in plain YAML or JSON; OpenImuCameraCalibrator (UMI)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from lerobot_symview.calibration.formats.document import FILE_STORAGE, Document
from lerobot_symview.calibration.formats.facts import (
    BASE_TO_CAMERA,
    OPTICAL,
    CameraFacts,
    Facts,
    Format,
    Pose,
    Size,
    image_size,
    intrinsics_matrix,
    lens,
    matrix_pose,
    number,
    numbers,
    optional_size,
    pinhole,
)
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.lens import EQUIDISTANT, PLUMB_BOB

MATRIX = ("camera_matrix", "cameramatrix", "k", "mtx", "intrinsics", "intrinsic", "intrinsic_matrix", "m1", "m")
COEFFICIENTS = (
    "distortion_coefficients", "distortion", "dist_coeffs", "dist_coeff", "distcoeffs", "dist", "d", "d1",
)  # fmt: skip
ROTATION, TRANSLATION = ("rvec", "rotation_vector"), ("tvec", "translation_vector", "translation")
HEIGHT, WIDTH = ("image_height", "height"), ("image_width", "width")


def _is_file_storage(document: Document) -> bool:
    return any(mark in document.text for mark in FILE_STORAGE)


def _file_storage(document: Document, size: Size | None) -> Facts:
    text = document.text.lstrip("\ufeff \r\n")
    if not text.startswith(("%YAML", "<?xml", "{")):
        text = "%YAML:1.0\n---\n" + text.removeprefix("---")
    storage = cv2.FileStorage()
    try:
        if not storage.open(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY):
            raise CalibrationError("OpenCV cannot read it")
        root = storage.root()
        entries = {name: _node(root.getNode(name)) for name in root.keys()}  # noqa: SIM118
    finally:
        storage.release()
    facts = _facts(entries)
    poses = [name for name, value in entries.items() if np.shape(value) == (4, 4)]
    if facts.pose is None and len(poses) > 1:
        raise CalibrationError(f"it has several 4 x 4 matrices: {', '.join(poses)}; keep the camera's pose")
    pose = matrix_pose(poses[0], entries[poses[0]], axes=OPTICAL) if poses else facts.pose
    return {"": replace(facts, pose=pose)}


def _node(node: cv2.FileNode) -> Any:
    """Return a matrix, number or text; None for another node."""
    if node.isInt() or node.isReal():
        return node.real()
    if node.isString():
        return node.string()
    if node.isMap():
        return node.mat()
    if node.isSeq():
        values = [node.at(index) for index in range(node.size())]
        return [value.real() for value in values] if all(value.isInt() or value.isReal() for value in values) else None
    return None


def _is_plain(document: Document) -> bool:
    names = {name.lower() for name in document.entries()}
    return bool(names & set(MATRIX)) and bool(names & {*COEFFICIENTS, *ROTATION, *HEIGHT})


def _plain(document: Document, size: Size | None) -> Facts:
    """K as `camera_matrix` or another usual name, with the lens beside it, as Python's `json.dump` writes them."""
    entries = document.entries()
    return {"": _facts({name: _data(value) for name, value in entries.items()})}


def _data(value: Any) -> Any:
    return value.get("data", value) if isinstance(value, Mapping) else value


def _facts(entries: Mapping[str, Any]) -> CameraFacts:
    lower = {name.lower(): value for name, value in entries.items() if value is not None}

    def pick(names: tuple[str, ...]) -> Any:
        return next((lower[name] for name in names if name in lower), None)

    matrix, coefficients, rotation, translation = map(pick, (MATRIX, COEFFICIENTS, ROTATION, TRANSLATION))
    size = optional_size({"height": pick(HEIGHT), "width": pick(WIDTH)})
    pose = None
    if rotation is not None and translation is not None:  # of solvePnP: of the board or the world in the camera
        vector = numbers("rotation vector", rotation, 3)
        pose = Pose(cv2.Rodrigues(vector)[0], numbers("translation", translation, 3), BASE_TO_CAMERA, OPTICAL)
    if matrix is None:
        return CameraFacts(size=size, pose=pose)
    fisheye = str(lower.get("distortion_model", lower.get("model", ""))).lower() in ("fisheye", EQUIDISTANT)
    return CameraFacts(
        intrinsics_matrix("the camera matrix", matrix),
        size,
        pose=pose,
        **lens(EQUIDISTANT if fisheye else None, [] if coefficients is None else coefficients),
    )


def _is_umi(document: Document) -> bool:
    return {"intrinsic_type", "intrinsics"} <= set(document.entries())


def _umi(document: Document, size: Size | None) -> Facts:
    entries = document.entries()
    values = entries["intrinsics"]
    if abs(number("skew", values.get("skew", 0))) > 1e-6:
        raise CalibrationError(f"K has a skew of {values['skew']}, expected none")
    if "focal_length" in values:
        fx = number("focal_length", values["focal_length"])
        fy = fx * number("aspect_ratio", values.get("aspect_ratio", 1))
    else:
        fx, fy = values["fx"], values["fy"]
    center = [values.get(f"principal_pt_{axis}", values.get(f"c{axis}")) for axis in "xy"]
    radial = [values.get(f"radial_distortion_{index}", 0) for index in (1, 2, 3, 4)]
    if entries["intrinsic_type"] == "FISHEYE":
        model, coefficients = EQUIDISTANT, radial
    elif str(entries["intrinsic_type"]).startswith("PINHOLE"):
        tangential = [values.get(f"tangential_distortion_{index}", 0) for index in (1, 2)]
        model, coefficients = PLUMB_BOB, [*radial[:2], *tangential, radial[2]]
    else:
        raise CalibrationError(f"intrinsic_type must be PINHOLE… or FISHEYE, got {entries['intrinsic_type']!r}")
    distortion = lens(model, numbers("distortion", coefficients, len(coefficients)))
    shape = image_size(entries["image_height"], entries["image_width"])
    return {"": CameraFacts(pinhole(fx, fy, *center), shape, **distortion)}


FILE_STORAGE_FORMAT = Format("OpenCV FileStorage", _is_file_storage, _file_storage)
PLAIN = Format("camera matrix in YAML or JSON", _is_plain, _plain)
UMI = Format("OpenImuCameraCalibrator JSON (UMI)", _is_umi, _umi)
