"""Files of depth cameras: RealSense, Orbbec, Azure Kinect and ZED."""

from __future__ import annotations

import configparser
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from lerobot_symview.calibration.formats.document import Document
from lerobot_symview.calibration.formats.facts import (
    CameraFacts,
    Facts,
    Format,
    Size,
    choose_size,
    image_size,
    lens,
    number,
    numbers,
    pinhole,
)
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Array
from lerobot_symview.geometry.lens import EQUIDISTANT, PLUMB_BOB, RATIONAL
from lerobot_symview.geometry.units import MILLIMETRES

REALSENSE_MODELS = {"brown conrady": PLUMB_BOB, "kannala brandt4": EQUIDISTANT}
ZED_SIZES = {
    "2K": (1242, 2208), "FHD": (1080, 1920), "FHD1200": (1200, 1920), "HD": (720, 1280), "SVGA": (600, 960),
    "VGA": (376, 672),
}  # fmt: skip


def _is_realsense(document: Document) -> bool:
    return {"ppx", "ppy", "fx"} <= set(document.entries())


def _realsense(document: Document, size: Size | None) -> Facts:
    """The fields of `rs2_intrinsics`."""
    entries = document.entries()
    coefficients = numbers("coeffs", entries.get("coeffs", [0] * 5), 5)
    name = re.sub("[^a-z0-9]+", " ", str(entries.get("model", "")).lower().removeprefix("distortion.")).strip()
    model = REALSENSE_MODELS.get(name, name)
    if model == EQUIDISTANT:
        coefficients = coefficients[:4]
    matrix = pinhole(entries["fx"], entries.get("fy"), entries["ppx"], entries["ppy"])
    return {"": CameraFacts(matrix, image_size(entries["height"], entries["width"]), **lens(model, coefficients))}


def _blocks(entries: Mapping[str, Any]) -> dict[Size, Mapping[str, Any]]:
    found = {}
    for key, value in entries.items():
        match = re.fullmatch(r"(?:color_?)?(\d{2,5})\s*[xX]\s*(\d{2,5})", str(key))
        if match and isinstance(value, Mapping):
            found[int(match[2]), int(match[1])] = value
    return found


def _color(document: Document) -> Mapping[str, Any]:
    entries = document.entries()
    color = entries.get("color")
    return entries if _blocks(entries) or not isinstance(color, Mapping) else color


def _is_orbbec(document: Document) -> bool:
    return bool(_blocks(_color(document)))


def _orbbec(document: Document, size: Size | None) -> Facts:
    """A block for each image size; depth_to_color in millimetres."""
    shape, block = choose_size(_blocks(_color(document)), size)
    values = block.get("intrinsic", block.get("intrinsics", block))
    center = _center(values)
    distortion = block.get("distortion") or {}
    if isinstance(distortion, Mapping):
        distortion = [distortion.get(name, 0) for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
    coefficients = numbers("distortion", distortion, len(distortion))
    if len(coefficients) == 8 and not coefficients[5:].any():
        coefficients = coefficients[:5]
    extrinsic = document.entries().get("depth_to_color")
    return {
        "": CameraFacts(
            pinhole(values.get("fx"), values.get("fy"), *center),
            shape,
            **lens(None, coefficients),
            color_from_depth=None if extrinsic is None else _color_from_depth(extrinsic),
            depth_intrinsics=_only_intrinsics(document.entries().get("depth")),
        )
    }


def _only_intrinsics(entries: Any) -> Array | None:
    """Return K of a depth camera; None if the file has none, or several sizes, of which depth images may have any."""
    blocks = list(_blocks(entries).values()) if isinstance(entries, Mapping) else []
    if len(blocks) != 1:
        return None
    values = blocks[0].get("intrinsic", blocks[0].get("intrinsics", blocks[0]))
    return pinhole(*(values.get(f"f{axis}") for axis in "xy"), *_center(values))


def _center(values: Mapping[str, Any]) -> list[Any]:
    return [values.get(f"c{axis}", values.get(f"pp{axis}")) for axis in "xy"]


def _color_from_depth(entries: Mapping[str, Any]) -> Array:
    color_from_depth = np.eye(4)
    color_from_depth[:3, :3] = numbers("depth_to_color rotation", entries["rotation"], 3, 3)
    color_from_depth[:3, 3] = numbers("depth_to_color translation", entries["translation"], 3) * MILLIMETRES
    return color_from_depth


def _is_azure(document: Document) -> bool:
    return "CalibrationInformation" in document.entries()


def _azure(document: Document, size: Size | None) -> Facts:
    """The colour camera of Azure Kinect's raw calibration, whose K is normalised by the size of the 4:3 image.

    Images of 16:9 are its middle rows. Pixel centres are at 0.5 there.
    """
    cameras = document.entries()["CalibrationInformation"]["Cameras"]
    color = [camera for camera in cameras if "PhotoVideo" in str(camera.get("Purpose", camera.get("Location", "")))]
    color = color or [camera for camera in cameras if "PV" in str(camera.get("Location"))]
    if len(color) != 1:
        raise CalibrationError(f"expected one colour camera (Location …PV0), got {len(color)}")
    intrinsics = color[0]["Intrinsics"]
    if "BrownConrady" not in str(intrinsics["ModelType"]):
        raise CalibrationError(f"the lens model {intrinsics['ModelType']!r} is not supported, expected BrownConrady")
    height, width = size or image_size(color[0]["SensorHeight"], color[0]["SensorWidth"])
    full = width * 3 / 4
    if height not in (full, width * 9 / 16):
        raise CalibrationError(f"expected an image of 4:3 or 16:9, as Azure Kinect's, got {width} x {height}")
    parameters = intrinsics["ModelParameters"]
    cx, cy, fx, fy, *radial, _, _, p2, p1 = numbers("ModelParameters", parameters[:14], 14)
    k1, k2, *rest = radial
    matrix = pinhole(fx * width, fy * full, cx * width - 0.5, cy * full - (full - height) / 2 - 0.5)
    return {"": CameraFacts(matrix, (height, width), **lens(RATIONAL, [k1, k2, p1, p2, *rest]))}


def _is_zed(document: Document) -> bool:
    return "[LEFT_CAM_" in document.text


def _zed(document: Document, size: Size | None) -> Facts:
    """The cameras left and right of a ZED, in the section of the image size."""
    parser = configparser.ConfigParser(strict=False)
    try:
        parser.read_string(document.text)
    except configparser.Error as error:
        raise CalibrationError(" ".join(str(error).split())) from None
    facts = {}
    for side in ("LEFT", "RIGHT"):
        sections = {
            shape: parser[f"{side}_CAM_{name}"] for name, shape in ZED_SIZES.items() if f"{side}_CAM_{name}" in parser
        }
        if not sections:
            continue
        shape, section = choose_size(sections, size)
        matrix = pinhole(*(section.get(name) for name in ("fx", "fy", "cx", "cy")))
        coefficients = [number(name, section.get(name, "0")) for name in ("k1", "k2", "p1", "p2", "k3")]
        facts[side.lower()] = CameraFacts(matrix, shape, **lens(PLUMB_BOB, coefficients))
    return facts


REALSENSE = Format("RealSense JSON", _is_realsense, _realsense)
ORBBEC = Format("Orbbec or RealSense JSON, one block per image size", _is_orbbec, _orbbec)
AZURE_KINECT = Format("Azure Kinect raw calibration", _is_azure, _azure)
ZED = Format("ZED .conf", _is_zed, _zed)
