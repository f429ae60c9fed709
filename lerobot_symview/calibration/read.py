"""Reads the calibration of cameras from files, our own or those of other tools."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_symview.calibration.convert import convert
from lerobot_symview.calibration.file import POSES, Calibration, parse_calibration
from lerobot_symview.calibration.readings import PoseReading
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera, orbit_pose
from lerobot_symview.geometry.workspace import Workspace

logger = logging.getLogger(__name__)

ANY_POSE = orbit_pose(1.0, 0.0, 1.0, (0.0, 0.0, 0.0))
OFF_CENTER = 0.2  # of the image's side: distance of the principal point from the middle


def read_calibration(
    files: Path | str | Sequence[Path | str],
    camera: str | None = None,
    size: tuple[int, int] | None = None,
    workspace: Workspace | None = None,
    reading: PoseReading | None = None,
) -> Calibration:
    """Read a calibration file of our own format, see `lerobot_symview.calibration.file`, or files of other tools.

    Args:
        files: a file, or several that complete each other, such as one with K and one with a pose.
        camera: the camera's name, for files of other tools.
        size: rows and columns of its images, for files that do not say it.
        workspace: what the camera sees, to decide between readings of a pose.
        reading: how to read the pose, in place of what the file says.

    Raises:
        CalibrationError: if a file cannot be read, its content is invalid, or something is missing; one message lists
            all problems.
    """
    listed = [files] if isinstance(files, Path | str) else list(files)
    return _parsed(convert(listed, camera, size, workspace, reading), listed)


def read_intrinsics(file: Path | str, camera: str, size: tuple[int, int] | None = None) -> Camera:
    """Read a camera's image size, K, lens and depth sensor from a file that may lack its pose; the pose is arbitrary.

    Args:
        file: of our own format or of another tool.
        camera: its name, in a file with several.
        size: rows and columns of its images, for files that do not say it.

    Raises:
        CalibrationError: if the file cannot be read, its content is invalid, or intrinsics or image size are missing.
    """
    content = convert([file], camera, size, pose_needed=False)
    ((name, entries),) = content["cameras"].items()
    known = {key: value for key, value in entries.items() if key not in (*POSES, "quaternion_xyzw")}
    calibration = _parsed(content | {"cameras": {name: known | {"world_from_cam": ANY_POSE.tolist()}}}, [file])
    return calibration.camera(name)


def _parsed(content: Mapping[str, Any], files: Sequence[Path | str]) -> Calibration:
    try:
        calibration = parse_calibration(content)
    except CalibrationError as error:
        raise CalibrationError(f"{' and '.join(map(str, files))}: {error}") from None
    _warn_of_resized(calibration)
    return calibration


def _warn_of_resized(calibration: Calibration) -> None:
    """Warn of principal points far from the middle: K is often that of another image size, or never calibrated."""
    for name, camera in calibration.cameras.items():
        x, y = abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5)
        if max(x, y) > OFF_CENTER:
            logger.warning(
                "camera %r: the principal point (%.4g, %.4g) is far from the middle of the %d x %d image: "
                "are the intrinsics those of another image size?",
                name,
                camera.cx,
                camera.cy,
                camera.width,
                camera.height,
            )
