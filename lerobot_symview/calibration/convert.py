"""Calibration files of any format, alone or combined, as the content of our own file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_symview.calibration.file import (
    METRES,
    POSES,
    parse_calibration,
    parse_workspace,
    plain_depth_sensor,
    without_table_height,
)
from lerobot_symview.calibration.formats import FORMATS, CameraFacts, Facts, Format, parse, recognise
from lerobot_symview.calibration.formats.document import Document, read_document
from lerobot_symview.calibration.formats.facts import Pose, Size
from lerobot_symview.calibration.readings import PoseReading, resolve
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import DepthSensor
from lerobot_symview.geometry.workspace import Workspace

HAS_INTRINSICS = "ROS camera_info, OpenCV's camera_matrix, Kalibr's camchain or RealSense's JSON"
HAS_POSE = "easy_handeye2's, DROID's, or a 4 x 4 matrix"


@dataclass(frozen=True)
class _Source:
    """What one file contributes: entries of our own file by part, and a pose that is still to be read."""

    file: Path
    parts: dict[str, dict[str, Any]] = field(default_factory=dict)
    pose: Pose | None = None


def convert(
    files: Sequence[Path | str],
    camera: str | None = None,
    size: Size | None = None,
    workspace: Workspace | None = None,
    reading: PoseReading | None = None,
    *,
    pose_needed: bool = True,
) -> dict[str, Any]:
    """Return the content of our own calibration file, from one file or from several that complete each other.

    Args:
        files: our own file alone is returned as it is.
        camera: the camera's name in the result, and in files with several; by default the name in the files.
        size: rows and columns of the camera's images, for files that do not say it, or have several.
        workspace: what the camera sees, to decide between readings of a pose.
        reading: how to read the pose, where its file does not say it or is wrong.
        pose_needed: if not, the files may lack a pose, and one whose reading is to be found is left out.

    Raises:
        CalibrationError: if a file cannot be read, the files contradict each other, or something is missing.
    """
    documents = {Path(file): read_document(file) for file in files}
    if not documents:
        raise CalibrationError("no calibration file is given")
    if len(documents) == 1 and pose_needed:
        ((file, document),) = documents.items()
        if _format(document) is None:
            return _our_content(file, document)
    units, named, workspaces, sources = "m", [], [], []
    for file, document in documents.items():
        known = _format(document)
        if known is None:
            content = _our_content(file, document)
            cameras = content.get("cameras")
            name, entries = _pick(file, cameras if isinstance(cameras, Mapping) else {}, camera)
            source = _from_ours(file, entries, METRES.get(str(content.get("units", "m")), 1.0))
            units = content.get("units", "m") if "pose" in source.parts else units
            workspaces += [content["workspace"]] if content.get("workspace") is not None else []
        else:
            name, facts = _pick(file, _read(file, document, known, size), camera)
            source = _from_facts(file, facts)
        sources.append(source)
        named += [name] if name else []
    camera = camera or (named[0] if named else "camera")
    if workspaces:
        workspace = parse_workspace(without_table_height(workspaces[0])[0])
    entries = _join(sources, camera, size, pose_needed)
    if "depth_sensor" in entries:
        entries["depth_sensor"] = _scaled(entries["depth_sensor"], 1 / METRES.get(str(units), 1.0))
    pose = next(((source.file, source.pose) for source in sources if source.pose is not None), None)
    if pose is not None and pose_needed:
        try:
            entries |= resolve(camera, entries, pose[1], reading or PoseReading(), workspace)
        except CalibrationError as error:
            raise type(error)(f"{pose[0]}: {error}") from None
    shown = {"workspace": workspaces[0]} if workspaces else {}
    return {"units": units, **shown, "cameras": {camera: entries}}


def _is_ours(document: Document) -> bool:
    return bool({"units", "cameras"} & set(document.entries()))


def _format(document: Document) -> Format | None:
    """Return the format of another tool's file; None for our own, and for a file of an unknown format."""
    return None if _is_ours(document) else recognise(document)


def _our_content(file: Path, document: Document) -> dict[str, Any]:
    """Return the content of our own file; raise an error for a file of an unknown format."""
    if document.problem:
        raise CalibrationError(f"cannot read {file}: {document.problem}")
    if not _is_ours(document):
        try:
            parse_calibration(document.content)
        except CalibrationError as error:
            titles = ", ".join(known.title for known in FORMATS.values())
            raise CalibrationError(f"{file}: {error}; or a file of {titles}") from None
    content: dict[str, Any] = document.content
    return content


def _read(file: Path, document: Document, known: Format, size: Size | None) -> Facts:
    try:
        return parse(document, known, size)
    except CalibrationError as error:
        raise CalibrationError(f"{file}: {error}") from None


def _pick[Value](file: Path, cameras: Mapping[str, Value], wanted: str | None) -> tuple[str, Value]:
    """Return name and value of the wanted camera: of this name, the only one, or the only one with it in its name."""
    if wanted in cameras:
        return str(wanted), cameras[str(wanted)]
    names = list(cameras) if len(cameras) == 1 else [name for name in cameras if wanted and wanted in str(name)]
    if len(names) != 1:
        asked = f"none is {wanted!r}" if wanted else "say which"
        raise CalibrationError(f"{file} has the cameras {', '.join(map(str, cameras)) or '(none)'}: {asked}")
    return str(names[0]), cameras[names[0]]


def _from_facts(file: Path, facts: CameraFacts) -> _Source:
    parts: dict[str, dict[str, Any]] = {}
    if facts.intrinsics is not None:
        parts["intrinsics"] = {"intrinsics": facts.intrinsics.tolist()}
        if facts.distortion:
            parts["intrinsics"] |= {
                "distortion": list(facts.distortion),
                "distortion_model": facts.distortion_model,
            }
    if facts.size is not None:
        parts["image size"] = dict(zip(("height", "width"), facts.size, strict=True))
    if facts.depth_unit is not None:
        parts["depth unit"] = {"depth_unit": facts.depth_unit}
    if facts.depth_intrinsics is not None and facts.color_from_depth is not None:
        sensor = DepthSensor(facts.depth_intrinsics, facts.color_from_depth)
        parts["depth sensor"] = plain_depth_sensor(sensor)
    if facts.pose is not None:
        parts["pose"] = {}
    return _Source(file, parts, facts.pose)


def _from_ours(file: Path, entries: Any, metres: float) -> _Source:
    """Return the parts of our own file; its depth sensor in metres, as that of other tools, whatever its units."""
    if not isinstance(entries, Mapping):
        raise CalibrationError(f"{file}: expected a mapping for the camera, got {entries!r}")
    part_of = dict.fromkeys((*POSES, "quaternion_xyzw"), "pose")
    part_of |= {"height": "image size", "width": "image size"}
    part_of |= {"depth_unit": "depth unit", "depth_sensor": "depth sensor"}
    parts: dict[str, dict[str, Any]] = {}
    for key, value in entries.items():
        part = part_of.get(key, "intrinsics")
        parts.setdefault(part, {})[key] = _scaled(value, metres) if key == "depth_sensor" else value
    return _Source(file, parts)


def _scaled(depth_sensor: Any, factor: float) -> Any:
    """Return a depth sensor's entries with another unit of length; what is no sensor is left to `parse_calibration`."""
    if not isinstance(depth_sensor, Mapping):
        return depth_sensor
    entries = dict(depth_sensor)
    try:
        if "position" in entries:
            entries["position"] = (np.array(entries["position"], dtype=float) * factor).tolist()
        elif "color_from_depth" in entries:
            matrix = np.array(entries["color_from_depth"], dtype=float)
            matrix[:3, 3] *= factor
            entries["color_from_depth"] = matrix.tolist()
    except (TypeError, ValueError, IndexError):
        return depth_sensor
    return entries


def _join(sources: Sequence[_Source], camera: str, size: Size | None, pose_needed: bool) -> dict[str, Any]:
    """Return the entries of all files, except the pose that is still to be read."""
    joined: dict[str, Any] = {}
    owner: dict[str, _Source] = {}
    for source in sources:
        for part, entries in source.parts.items():
            if part in owner and (part == "pose" or not _equal(owner[part].parts[part], entries)):
                raise CalibrationError(
                    f"{owner[part].file} and {source.file} both give the {part} of camera {camera!r}"
                )
            owner[part] = source
            joined |= entries
    gives = ", ".join(owner) or "nothing"
    if "image size" not in owner and size is not None:
        joined |= {"height": size[0], "width": size[1]}
    files = " and ".join(str(source.file) for source in sources)
    missing = []
    if "intrinsics" not in owner:
        missing.append(f"no intrinsics: add a file with K, such as {HAS_INTRINSICS}")
    if pose_needed and "pose" not in owner:
        missing.append(
            f"no pose of the camera in the robot's base or the world: add a file with it, such as {HAS_POSE}"
        )
    if "height" not in joined or "width" not in joined:
        missing.append(
            "no height and width of the image: add a file with them, such as ROS camera_info, or give "
            "--image_size='[rows, columns]' to symview-calibrate"
        )
    if missing:
        verb = "has" if len(sources) == 1 else "have"
        raise CalibrationError(f"{files} {verb} the {gives} of camera {camera!r}, but {'; and '.join(missing)}")
    return joined


def _equal(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Whether two files say the same of a part."""
    if set(first) != set(second):
        return False
    try:
        return all(
            first[key] == second[key] if key == "distortion_model" else np.allclose(first[key], second[key])
            for key in first
        )
    except (TypeError, ValueError):
        return first == second
