"""Camera calibration from a file, for datasets and robots that do not store it.

Matrices are rounded to float32, the precision of datasets, so that views rendered with the file's matrices and with a
dataset's stored matrices are bit-identical.

The file is YAML or JSON:

    units: m                        # of the translations, m or mm; K is in pixels
    workspace:                      # the square on the table that views show, metres; optional
      center: [0.45, 0.0]
      size: 0.4
    cameras:
      front:                        # as in observation.images.front
        height: 480
        width: 640
        intrinsics: [[615.3, 0, 319.5], [0, 615.1, 239.5], [0, 0, 1]]
        world_from_cam:             # OpenCV axes; the world's z axis points up and its table is z = 0
          - [0,  0.70711, -0.70711, 1.02]
          - [1,  0,        0,       0   ]
          - [0, -0.70711, -0.70711, 0.57]
          - [0,  0,        0,       1   ]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Array, Camera
from lerobot_symview.geometry.workspace import Workspace

METRES = {"m": 1.0, "mm": 0.001}
CAMERA_ENTRIES = ("height", "width", "intrinsics", "world_from_cam")


@dataclass(frozen=True)
class Calibration:
    """Fixed cameras by name, and the workspace if the file declares one."""

    cameras: dict[str, Camera]
    workspace: Workspace | None = None

    def camera(self, name: str) -> Camera:
        """Return the camera `name`.

        Raises:
            CalibrationError: if the calibration has no such camera.
        """
        if name not in self.cameras:
            raise CalibrationError(f"the calibration has no camera {name!r}; it has {', '.join(self.cameras)}")
        return self.cameras[name]


def read_calibration(file: Path | str) -> Calibration:
    """Read a calibration file in the format described at the top of this module.

    Raises:
        CalibrationError: if the file cannot be read as YAML or JSON, or its content is invalid; one message lists all
            problems.
    """
    import yaml

    try:
        text = Path(file).read_text()
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text)):
            raise CalibrationError(f"{file} has an alias (*name): write out the value it refers to")
        content = yaml.safe_load(text)
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        raise CalibrationError(f"cannot read {file}: {error}") from None
    try:
        return parse_calibration(content)
    except CalibrationError as error:
        raise CalibrationError(f"{file}: {error}") from None


def parse_calibration(content: Any) -> Calibration:
    """Return the calibration that the content of a file describes.

    Raises:
        CalibrationError: if the content is invalid; one message lists all problems.
    """
    if not isinstance(content, Mapping):
        raise CalibrationError(f"expected a mapping with units and cameras, got {type(content).__name__}")
    problems = _unknown_keys("the file", content, ("units", "workspace", "cameras"))
    units = content.get("units")
    if not isinstance(units, str) or units not in METRES:
        problems.append(f"units must be m or mm, got {units!r}")
    named = content.get("cameras")
    if not isinstance(named, Mapping) or not named:
        problems.append("cameras must be a mapping with at least one camera")
        named = {}
    metres = METRES.get(str(units), 1.0)
    cameras, workspace = {}, None
    for name, entries in named.items():
        try:
            cameras[str(name)] = _camera(entries, metres)
        except CalibrationError as error:
            problems.append(f"camera {name!r}: {error}")
    if content.get("workspace") is not None:
        try:
            workspace = parse_workspace(content["workspace"])
        except CalibrationError as error:
            problems.append(f"workspace: {error}")
    if problems:
        raise CalibrationError("; ".join(problems))
    return Calibration(cameras, workspace)


def parse_workspace(entries: Any) -> Workspace:
    """Return the workspace with the arguments of `Workspace` given in a mapping.

    Raises:
        CalibrationError: if an argument is unknown or invalid.
    """
    known = [field.name for field in fields(Workspace)]
    if not isinstance(entries, Mapping) or set(entries) - set(known):
        raise CalibrationError(f"expected a mapping with any of {', '.join(known)}, got {entries!r}")
    try:
        arguments: dict[str, Any] = {key: float(value) for key, value in entries.items() if key != "center"}
        if "center" in entries:
            x, y = map(float, entries["center"])
            return Workspace(center=(x, y), **arguments)
        return Workspace(**arguments)
    except (TypeError, ValueError) as error:
        raise CalibrationError(str(error)) from None


def plain_calibration(calibration: Calibration) -> dict[str, Any]:
    """Return the calibration as JSON-compatible data that `parse_calibration` reads."""
    cameras = {
        name: {
            "height": camera.height,
            "width": camera.width,
            "intrinsics": camera.intrinsics.tolist(),
            "world_from_cam": camera.world_from_cam.tolist(),
        }
        for name, camera in calibration.cameras.items()
    }
    content: dict[str, Any] = {"units": "m", "cameras": cameras}
    if calibration.workspace is not None:
        content["workspace"] = asdict(calibration.workspace) | {"center": list(calibration.workspace.center)}
    return content


def _camera(entries: Any, metres: float) -> Camera:
    if not isinstance(entries, Mapping):
        raise CalibrationError(f"expected a mapping with {', '.join(CAMERA_ENTRIES)}, got {entries!r}")
    missing = [entry for entry in CAMERA_ENTRIES if entry not in entries]
    problems = _unknown_keys("it", entries, CAMERA_ENTRIES)
    if missing:
        problems.append(f"lacks {', '.join(missing)}")
    if problems:
        raise CalibrationError("; ".join(problems))
    for side in ("height", "width"):
        if not isinstance(entries[side], int) or entries[side] < 1:
            raise CalibrationError(f"{side} must be a positive number of pixels, got {entries[side]!r}")
    intrinsics, world_from_cam = _matrix("intrinsics", entries, 3), _matrix("world_from_cam", entries, 4)
    world_from_cam[:3, 3] *= metres
    return Camera(_as_float32(intrinsics), _as_float32(world_from_cam), entries["height"], entries["width"])


def _matrix(name: str, entries: Mapping[str, Any], side: int) -> Array:
    try:
        return np.array(entries[name], dtype=np.float64).reshape(side, side)
    except (TypeError, ValueError):
        raise CalibrationError(f"{name} must be {side} rows of {side} numbers, got {entries[name]!r}") from None


def _as_float32(matrix: Array) -> Array:
    with np.errstate(over="ignore"):  # Camera rejects infinite values
        return matrix.astype(np.float32).astype(np.float64)


def _unknown_keys(owner: str, entries: Mapping[Any, Any], known: tuple[str, ...]) -> list[str]:
    unknown = [str(key) for key in entries if key not in known]
    return [f"{owner} has unknown keys: {', '.join(unknown)}; expected {', '.join(known)}"] if unknown else []
