"""Writes calibrations, and pictures by which they are checked."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.calibration.file import (
    Calibration,
    parse_calibration,
    plain_calibration,
    plain_depth_sensor,
    plain_lens,
)
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Array, Camera
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import flagged
from symview_eval.calibrate.config import CalibrateConfig
from symview_eval.calibrate.picture import calibration_picture

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Result:
    """A calibrated camera, with the image and the corners that its picture shows."""

    camera: Camera
    rgb: NDArray[np.uint8] | None = None
    corners: Array | None = None
    caption: str = ""
    depth_unit: float | None = None


def existing_calibration(file: Path) -> Calibration:
    """Return the calibration in the output, to which the camera is added."""
    if not file.exists():
        return Calibration({})
    with flagged("--output"):
        known = read_calibration(file)
        if known.is_in_base_axes or known.origin_height:
            raise CalibrationError(
                f"{file} has robot_base or table_height, which place its cameras in another frame than this one: write "
                "to another file, and copy the camera's entry"
            )
        return known


def write_result(config: CalibrateConfig, known: Calibration, workspace: Workspace, result: Result) -> Path:
    """Write the calibration and its picture; the calibration last, and at once."""
    camera = result.camera
    entry: dict[str, Any] = {
        "height": camera.height,
        "width": camera.width,
        "intrinsics": np.round([camera.fx, camera.fy, camera.cx, camera.cy], 4).tolist(),
        "world_from_cam": camera.world_from_cam.round(7).tolist(),
        **plain_lens(camera.lens),
        **plain_depth_sensor(camera.depth_sensor),
    }
    if camera.lens is not None:
        entry["distortion"] = np.round(camera.lens.coefficients, 8).tolist()
    depth_unit = result.depth_unit or known.depth_units.get(config.camera)
    if depth_unit is not None:
        entry["depth_unit"] = depth_unit
    content = {
        "units": "m",
        "workspace": asdict(workspace) | {"center": list(workspace.center)},
        "cameras": plain_calibration(known)["cameras"] | {config.camera: entry},
    }
    parse_calibration(content)
    config.output.parent.mkdir(parents=True, exist_ok=True)
    files = [config.output]
    if result.rgb is not None:
        files.append(config.output.with_name(f"{config.output.stem}_{config.camera}.png"))
        _picture(config, workspace, result).save(files[-1])
    replace_file(config.output, _yaml(content))
    x, y, z = camera.position
    logger.info(
        "camera %r is at x %.3f, y %.3f, z %.3f m; wrote %s", config.camera, x, y, z, " and ".join(map(str, files))
    )
    return config.output


def replace_file(file: Path, text: str) -> None:
    """Write a file at once."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(file.name + ".partial")
    part.write_text(text)
    part.replace(file)


def _picture(config: CalibrateConfig, workspace: Workspace, result: Result) -> Any:
    assert result.rgb is not None
    board = None if config.calibration or config.gripper.is_given else config.board.world_from_board
    return calibration_picture(
        result.rgb, result.camera, workspace, board, 2 * config.board.square, result.corners, result.caption
    )


def _yaml(content: dict[str, Any]) -> str:
    import yaml

    header = "# Written by symview-calibrate. Metres, OpenCV axes (x right, y down, z forward).\n"
    return header + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
