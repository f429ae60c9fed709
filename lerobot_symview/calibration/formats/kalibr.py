"""Kalibr: camchain.yaml. Its poses are relative to an IMU or to another camera, and are not read."""

from __future__ import annotations

from collections.abc import Mapping

from lerobot_symview.calibration.formats.document import Document
from lerobot_symview.calibration.formats.facts import (
    CameraFacts,
    Facts,
    Format,
    Size,
    image_size,
    lens,
    numbers,
    pinhole,
)
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.lens import EQUIDISTANT, PLUMB_BOB

MODELS = {"radtan": PLUMB_BOB, "equidistant": EQUIDISTANT}


def _has_model(entries: Mapping) -> bool:
    return "camera_model" in entries


def _recognises(document: Document) -> bool:
    return bool(document.cameras(_has_model))


def _parse(document: Document, size: Size | None) -> Facts:
    return {name: _camera(entries) for name, entries in document.cameras(_has_model).items()}


def _camera(entries: Mapping) -> CameraFacts:
    if entries["camera_model"] != "pinhole":
        raise CalibrationError(f"the camera model {entries['camera_model']!r} is not supported, expected pinhole")
    model = str(entries.get("distortion_model", "none"))
    coefficients = numbers("distortion_coeffs", [0] * 4 if model == "none" else entries["distortion_coeffs"], 4)
    height, width = reversed(entries["resolution"])
    return CameraFacts(
        pinhole(*numbers("intrinsics", entries["intrinsics"], 4)),
        image_size(height, width),
        **lens(MODELS.get(model, model), coefficients),
    )


CAMCHAIN = Format("Kalibr camchain", _recognises, _parse)
