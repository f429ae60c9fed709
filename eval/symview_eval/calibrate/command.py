"""`symview-calibrate`: a camera's pose and intrinsics from images of a printed board, or from other tools' files."""

from __future__ import annotations

import logging
from pathlib import Path

from numpy.typing import NDArray

from lerobot_symview.calibration.board import Board
from lerobot_symview.calibration.board_print import board_print, encode_print
from lerobot_symview.calibration.convert import convert
from lerobot_symview.calibration.file import Calibration, parse_calibration
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.calibration.table_plane import levelled, likely_depth_unit
from lerobot_symview.calibration.writers import WRITERS
from lerobot_symview.datasets.add_views import POSE_FLAGS, pose_flagged
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera, aligned_depth
from lerobot_symview.geometry.units import in_metres, parse_unit, unit_name
from lerobot_symview.geometry.visibility import camera_problem, check_camera
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import flagged, run_command
from symview_eval.calibrate.config import CalibrateConfig
from symview_eval.calibrate.from_board import from_board, photographs
from symview_eval.calibrate.from_gripper import from_gripper
from symview_eval.calibrate.output import Result, existing_calibration, replace_file, write_result
from symview_eval.calibrate.photographs import depth_from_dataset, depth_from_file
from symview_eval.live_camera import with_device

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-calibrate --board.print=board.pdf
  symview-calibrate --images=photos/ --camera=front
  symview-calibrate --images=photo.jpg --camera=front --intrinsics=615.3,615.1,319.5,239.5 --board.origin='[0.3, -0.1]'
  symview-calibrate --dataset.repo_id=me/real --camera=front --episodes='[0]' --frames=20
  symview-calibrate --device.type=opencv --device.index_or_path=0 --camera=front --frames=12
  symview-calibrate --dataset.repo_id=me/real --camera=front --gripper.marker=7 --frames=20 --intrinsics=lens.yaml
  symview-calibrate --calibration=cameras.yaml --refine=table --dataset.repo_id=me/real --camera=front
  symview-calibrate --convert='[camera_info.yaml, handeye.calib]' --camera=front --output=cameras.yaml
  symview-calibrate --convert='[cameras.yaml]' --camera=front --to=camera_info --output=camera_info.yaml"""


def calibrate(config: CalibrateConfig) -> Path:
    """Write the calibration or the board that `config` asks for, and return its file.

    Raises:
        CalibrationError: if the images do not determine the calibration; nothing is written.
    """
    if config.board.print is not None:
        return _print(config.board, config.board.print)
    if config.convert:
        return _convert(config)
    known = existing_calibration(config.output)
    workspace = (
        config.workspace or known.workspace or (Workspace() if config.gripper.is_given else _about(config.board))
    )
    if config.gripper.is_given:
        result = from_gripper(config, workspace)
    elif config.calibration is None:
        result = from_board(config)
    else:
        with flagged("--calibration"):
            result = Result(
                read_calibration(config.calibration).camera(config.camera),
                next(iter(photographs(config).values()), None),
            )
    if config.refine:
        result = _levelled(config, result, workspace)
    if config.workspace or known.workspace:
        with flagged("--workspace, --board"):
            check_camera(config.camera, result.camera, workspace)
    elif problem := camera_problem(result.camera, workspace):
        logger.warning("camera %r %s: give --workspace.center and --workspace.size", config.camera, problem)
    return write_result(config, known, workspace, result)


def _convert(config: CalibrateConfig) -> Path:
    """Write the files of other tools in our format, or in that of `to`."""
    known = Calibration({}) if config.to else existing_calibration(config.output)
    given = config.workspace or known.workspace
    with pose_flagged("--convert"):
        content = convert(config.convert, config.camera, config.image_size, given or Workspace(), config.pose)
    if config.to:
        replace_file(config.output, WRITERS[config.to](content, config.camera))
        logger.info("wrote %s", config.output)
        return config.output
    with flagged("--convert"):
        read = parse_calibration(content)
        camera = read.camera(config.camera)
    workspace = given or read.workspace or Workspace()
    if problem := camera_problem(camera, workspace):
        logger.warning("camera %r %s: give --workspace.center and --workspace.size", config.camera, problem)
    return write_result(config, known, workspace, Result(camera, depth_unit=read.depth_units.get(config.camera)))


def _print(board: Board, file: Path) -> Path:
    with flagged("--board.print"):
        printed = board_print(board)
        content = encode_print(printed, file.suffix)
    file.write_bytes(content)
    width, height = (1000 * length for length in board.size)
    logger.info(
        "wrote %s, a page of %.0f x %.0f mm: print it at 100 %%, glue it to something flat and measure the pattern, "
        "%.1f x %.1f mm; if it differs, pass the measured --board.square",
        file,
        *(25.4 * pixels / printed.dpi for pixels in printed.page.shape[::-1]),
        width,
        height,
    )
    return file


def _about(board: Board) -> Workspace:
    center = board.world_from_board @ [board.size[0] / 2, board.size[1] / 2, 0, 1]
    return Workspace(center=(round(float(center[0]), 4), round(float(center[1]), 4)))


def _levelled(config: CalibrateConfig, result: Result, workspace: Workspace) -> Result:
    """Return the result with the table of a depth image at z = 0."""
    unit = None if config.depth_unit is None else parse_unit(config.depth_unit)
    if config.depth is not None:
        with flagged("--depth"):
            stored = depth_from_file(config.depth)
        if unit is None and _fits(stored, result.camera):
            unit = likely_depth_unit(stored, result.camera.depth_camera(*stored.shape), workspace)
        depth = in_metres(stored, unit)
    else:
        assert config.dataset is not None
        with flagged("--dataset, --camera, --episodes"):
            depth = depth_from_dataset(config.dataset.folder(), config.camera, config.episodes[0], unit)
    if not _fits(depth, result.camera):
        raise CalibrationError(
            f"--refine=table: depth has {depth.shape[1]} x {depth.shape[0]} pixels, the camera {result.camera.width} x "
            f"{result.camera.height}: align it to colour, or give `depth_sensor` in the file of --intrinsics"
        )
    with flagged("--refine=table"):
        camera, plane = levelled(aligned_depth(depth, result.camera), result.camera, workspace)
    read = "" if unit is None else f" (depth in {unit_name(unit)})"
    logger.info("in the depth image%s %s, before the correction; now at z = 0", read, plane)
    return Result(camera, result.rgb, result.corners, f"{plane}: corrected")


def _fits(depth: NDArray, camera: Camera) -> bool:
    """Whether a depth image has the size of its camera, or is that of a depth sensor, which may have any size."""
    return camera.depth_sensor is not None or depth.shape == (camera.height, camera.width)


def main() -> None:
    """Run the console command."""
    run_command(with_device(CalibrateConfig), calibrate, EXAMPLES, short={"--root": "--dataset.root", **POSE_FLAGS})
