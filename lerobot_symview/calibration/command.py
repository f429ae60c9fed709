"""`symview-calibrate`: a camera's pose and intrinsics from images of a printed board, or from other tools' files."""

from __future__ import annotations

import logging
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_symview.calibration.board import Board
from lerobot_symview.calibration.board_corners import Corners, find_board, find_board_through_lens
from lerobot_symview.calibration.board_pose import (
    EstimatedIntrinsics,
    Intrinsics,
    board_pose,
    estimate_intrinsics,
    world_from_cam,
)
from lerobot_symview.calibration.board_print import board_print, encode_print
from lerobot_symview.calibration.convert import convert
from lerobot_symview.calibration.file import Calibration, parse_calibration, plain_calibration, read_calibration
from lerobot_symview.calibration.photographs import (
    Photographs,
    depth_from_dataset,
    depth_from_file,
    from_dataset,
    from_device,
    from_files,
)
from lerobot_symview.calibration.picture import calibration_picture
from lerobot_symview.calibration.readings import POSE_FLAGS, PoseReading, ReadingError
from lerobot_symview.calibration.table_plane import levelled, likely_depth_unit
from lerobot_symview.calibration.writers import WRITERS
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Array, Camera
from lerobot_symview.geometry.units import in_metres, parse_unit, unit_name
from lerobot_symview.geometry.visibility import camera_problem, check_camera
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.registry import lookup
from lerobot_symview.runtime.cli import CommandError, DatasetLocation, flagged, run_command

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-calibrate --board.print=board.pdf
  symview-calibrate --images=photos/ --camera=front
  symview-calibrate --images=photo.jpg --camera=front --intrinsics=615.3,615.1,319.5,239.5 --board.origin='[0.3, -0.1]'
  symview-calibrate --dataset.repo_id=me/real --camera=front --episodes='[0]' --frames=20
  symview-calibrate --device.type=opencv --device.index_or_path=0 --camera=front --frames=12
  symview-calibrate --calibration=cameras.yaml --refine=table --dataset.repo_id=me/real --camera=front
  symview-calibrate --convert='[camera_info.yaml, handeye.calib]' --camera=front --output=cameras.yaml
  symview-calibrate --convert='[cameras.yaml]' --camera=front --to=camera_info --output=camera_info.yaml"""


@dataclass(frozen=True)
class PrintedBoard(Board):
    """A board, and the file to print it from."""

    print: Path | None = None
    """Write the board as a .pdf or .png of its true size, and end."""


@dataclass(frozen=True)
class CalibrateConfig:
    """Find a camera's pose, and its intrinsics if they are not known, from images of a printed board on the table.

    Writes the calibration, and beside it a picture with the workspace and the board's axes drawn into the image.
    """

    board: PrintedBoard = field(default_factory=PrintedBoard)
    """The board, its place on the table, and where to print it to."""
    images: str | None = None
    """Images of the board: a file, a folder, or a pattern such as 'photos/*.jpg'."""
    dataset: DatasetLocation | None = None
    """Dataset whose frames of `camera` show the board."""
    episodes: list[int] = field(default_factory=lambda: [0])
    """Episodes of the dataset."""
    frames: int = 1
    """Images per episode of the dataset, evenly spaced, or images to take with the device, two seconds apart."""
    camera: str = "front"
    """Name of the camera in the calibration, as in observation.images.front."""
    pose_image: str = ""
    """Image that shows the board at its place on the table; by default the first. In all others it may be anywhere."""
    intrinsics: str = ""
    """`fx,fy,cx,cy` in pixels, or a calibration file with the camera. By default they are estimated from all images."""
    workspace: Workspace | None = None
    """Square on the table that views show; by default that of an existing output, else 0.4 m about the board."""
    refine: str = ""
    """`table`: tilt and lift the camera so that the table in a depth image lies at z = 0."""
    calibration: Path | None = None
    """Calibration file whose camera is refined, in place of one from images of a board."""
    depth: Path | None = None
    """Depth image of the table for `refine`, a 16-bit PNG, a TIFF or a .npy; by default the dataset's first frame."""
    depth_unit: str | None = None
    """Unit of depth: m, mm, or metres per unit; by default the dataset's, or the one that shows the table at z = 0."""
    convert: list[Path] = field(default_factory=list)
    """Calibration files of other tools, which complete each other, to write in place of a calibration from images."""
    pose: PoseReading = field(default_factory=PoseReading)
    """How to read the pose in `convert`; by default as its file says, else as the reading that sees the workspace."""
    image_size: tuple[int, int] | None = None
    """Rows and columns of the camera's images, for files in `convert` that do not say them."""
    to: str = ""
    """Format of the output of `convert`, `camera_info` or `easy_handeye2`; by default our own."""
    output: Path = Path("cameras.yaml")
    """Calibration file to write; other cameras in it are kept."""

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise ValueError(f"--frames must be at least 1, got {self.frames}")
        if self.to:
            lookup("--to", self.to, WRITERS)
        if self.to and not self.convert:
            raise ValueError("--to is the format that --convert writes: give both")
        if self.refine not in ("", "table"):
            raise ValueError(f"--refine must be table, got {self.refine!r}")
        if self.calibration is not None and not self.refine:
            raise ValueError("--calibration is what --refine=table corrects: give both")
        if self.refine and self.depth is None and self.dataset is None:
            raise ValueError("--refine=table needs a depth image: --depth, or --dataset with depth")
        if self.depth_unit is not None:
            try:
                parse_unit(self.depth_unit)
            except ValueError as error:
                raise ValueError(f"--depth_unit: {error}") from None


@dataclass(frozen=True, eq=False)
class Result:
    """A calibrated camera, with the image, the lens and the corners that its picture shows."""

    camera: Camera
    rgb: NDArray[np.uint8] | None = None
    distortion: Array = field(default_factory=lambda: np.zeros(0))
    corners: Array | None = None
    caption: str = ""
    depth_unit: float | None = None


def calibrate(config: CalibrateConfig) -> Path:
    """Write the calibration or the board that `config` asks for, and return its file.

    Raises:
        CalibrationError: if the images do not determine the calibration; nothing is written.
    """
    if config.board.print is not None:
        return _print(config.board, config.board.print)
    if config.convert:
        return _convert(config)
    known = _existing(config.output)
    workspace = config.workspace or known.workspace or _about(config.board)
    if config.calibration is None:
        result = _from_board(config)
    else:
        with flagged("--calibration"):
            result = Result(read_calibration(config.calibration).camera(config.camera), _first(_photographs(config)))
    if config.refine:
        result = _levelled(config, result, workspace)
    if config.workspace or known.workspace:
        with flagged("--workspace, --board"):
            check_camera(config.camera, result.camera, workspace)
    elif problem := camera_problem(result.camera, workspace):
        logger.warning("camera %r %s: give --workspace.center and --workspace.size", config.camera, problem)
    return _write(config, known, workspace, result)


def _convert(config: CalibrateConfig) -> Path:
    """Write the files of other tools in our format, or in that of `to`."""
    known = Calibration({}) if config.to else _existing(config.output)
    given = config.workspace or known.workspace
    with flagged("--convert"):
        try:
            content = convert(config.convert, config.camera, config.image_size, given or Workspace(), config.pose)
        except ReadingError as error:
            raise ReadingError(f"{error}; {', '.join(POSE_FLAGS)} and --pose.unit decide") from None
    if config.to:
        _replace(config.output, WRITERS[config.to](content, config.camera))
        logger.info("wrote %s", config.output)
        return config.output
    with flagged("--convert"):
        read = parse_calibration(content)
        camera = read.camera(config.camera)
    workspace = given or read.workspace or Workspace()
    if problem := camera_problem(camera, workspace):
        logger.warning("camera %r %s: give --workspace.center and --workspace.size", config.camera, problem)
    return _write(config, known, workspace, Result(camera, depth_unit=read.depth_units.get(config.camera)))


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


def _existing(file: Path) -> Calibration:
    """Return the calibration in the output, to which the camera is added."""
    if not file.exists():
        return Calibration({})
    with flagged("--output"):
        return read_calibration(file)


def _about(board: Board) -> Workspace:
    center = board.world_from_board @ [board.size[0] / 2, board.size[1] / 2, 0, 1]
    return Workspace(center=(round(float(center[0]), 4), round(float(center[1]), 4)))


def _photographs(config: CalibrateConfig) -> Photographs:
    """Return the images from the only source that is given."""
    device = getattr(config, "device", None)
    if config.images is not None:
        with flagged("--images"):
            return from_files(config.images)
    if config.dataset is not None:
        with flagged("--dataset, --camera, --episodes"):
            return from_dataset(config.dataset.folder(), config.camera, config.episodes, config.frames)
    if device is None:
        return {}
    try:
        return from_device(device, config.frames)
    except (ImportError, RuntimeError) as error:  # LeRobot's cameras raise these, and OSError
        raise CommandError(f"--device: {error}") from None


def _first(photographs: Photographs) -> NDArray[np.uint8] | None:
    return next(iter(photographs.values()), None)


def _from_board(config: CalibrateConfig) -> Result:
    photographs = _photographs(config)
    if not photographs:
        raise ValueError("give images of the board: --images, --dataset.repo_id or --device.type")
    sizes = {image.shape[:2] for image in photographs.values()}
    if len(sizes) > 1:
        listed = ", ".join(f"{width} x {height}" for height, width in sorted(sizes))
        raise CalibrationError(f"the images must be of one camera and size, got {listed}")
    pose_image = config.pose_image or next(iter(photographs))
    if pose_image not in photographs:
        raise ValueError(f"--pose_image={pose_image} is none of the images: {', '.join(photographs)}")
    image = photographs[pose_image]
    height, width = image.shape[:2]
    if config.intrinsics:
        intrinsics = _given_intrinsics(config, height, width)
    else:
        with flagged(f"{pose_image}, --board"):
            find_board(image, config.board)
        with flagged("--intrinsics, --images"):
            intrinsics = _reported(_estimated_intrinsics(photographs, config.board))
    with flagged(f"{pose_image}, --board"):
        corners = _find(image, config.board, intrinsics)
    with flagged(f"{pose_image}, --board, --intrinsics"):
        pose = board_pose(corners, intrinsics, width)
        camera = Camera(intrinsics.matrix, world_from_cam(pose, config.board.world_from_board), height, width)
    caption = f"{len(corners)} corners, reprojection error {pose.error_px:.2f} px, {pose.error_mm:.2f} mm on the table"
    logger.info(
        "%s: %s; board's orientation ± %.2f°, distance ± %.1f mm",
        pose_image,
        caption,
        pose.uncertainty_deg,
        pose.uncertainty_mm,
    )
    return Result(camera, image, intrinsics.distortion, corners.pixels, caption)


def _find(image: NDArray[np.uint8], board: Board, intrinsics: Intrinsics) -> Corners:
    if not intrinsics.distortion.any():
        return find_board(image, board)
    return find_board_through_lens(image, board, intrinsics.matrix, intrinsics.distortion)


def _estimated_intrinsics(photographs: Photographs, board: Board) -> EstimatedIntrinsics:
    """Estimate the intrinsics, then find the corners through the lens and estimate again; log images without board."""
    views = {}
    for name, image in photographs.items():
        try:
            views[name] = find_board(image, board)
        except CalibrationError as error:
            logger.warning("%s is not used: %s", name, error)
    height, width = next(iter(photographs.values())).shape[:2]
    first = estimate_intrinsics(views, height, width)
    return estimate_intrinsics({name: _find(photographs[name], board, first) for name in views}, height, width)


def _given_intrinsics(config: CalibrateConfig, height: int, width: int) -> Intrinsics:
    """Return the intrinsics of the flag, four numbers or a calibration file."""
    try:
        fx, fy, cx, cy = (float(number) for number in config.intrinsics.strip("[]").split(","))
    except ValueError:
        with flagged("--intrinsics"):
            known = read_calibration(config.intrinsics)
            name = next(iter(known.cameras)) if len(known.cameras) == 1 else config.camera
            camera = known.camera(name)
        if (camera.height, camera.width) != (height, width):
            raise CalibrationError(
                f"--intrinsics: camera {name!r} has images of {camera.width} x {camera.height} pixels, "
                f"these have {width} x {height}"
            ) from None
        return Intrinsics(camera.intrinsics)
    return Intrinsics(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))


def _reported(intrinsics: EstimatedIntrinsics) -> EstimatedIntrinsics:
    matrix = intrinsics.matrix
    for name, error in intrinsics.errors_px.items():
        logger.info("%s: reprojection error %.2f px", name, error)
    logger.info(
        "intrinsics from %d images: fx %.1f, fy %.1f (± %.2f %%), cx %.1f, cy %.1f, distortion %s",
        len(intrinsics.errors_px),
        matrix[0, 0],
        matrix[1, 1],
        100 * intrinsics.uncertainty,
        matrix[0, 2],
        matrix[1, 2],
        ", ".join(f"{value:.3g}" for value in intrinsics.distortion),
    )
    return intrinsics


def _levelled(config: CalibrateConfig, result: Result, workspace: Workspace) -> Result:
    """Return the result with the table of a depth image at z = 0."""
    unit = None if config.depth_unit is None else parse_unit(config.depth_unit)
    if config.depth is not None:
        with flagged("--depth"):
            stored = depth_from_file(config.depth)
        if stored.shape == (result.camera.height, result.camera.width):
            unit = unit or likely_depth_unit(stored, result.camera, workspace)
        depth = in_metres(stored, unit)
    else:
        assert config.dataset is not None
        with flagged("--dataset, --camera, --episodes"):
            depth = depth_from_dataset(config.dataset.folder(), config.camera, config.episodes[0], unit)
    if depth.shape != (result.camera.height, result.camera.width):
        raise CalibrationError(
            f"--refine=table: depth has {depth.shape[1]} x {depth.shape[0]} pixels, the camera "
            f"{result.camera.width} x {result.camera.height}: align it to colour"
        )
    with flagged("--refine=table"):
        camera, plane = levelled(depth, result.camera, workspace)
    read = "" if unit is None else f" (depth in {unit_name(unit)})"
    logger.info("in the depth image%s %s, before the correction; now at z = 0", read, plane)
    return Result(camera, result.rgb, result.distortion, result.corners, f"{plane}: corrected")


def _write(config: CalibrateConfig, known: Calibration, workspace: Workspace, result: Result) -> Path:
    """Write the calibration and its picture; the calibration last, and at once."""
    camera = result.camera
    entry: dict[str, Any] = {
        "height": camera.height,
        "width": camera.width,
        "intrinsics": np.round([camera.fx, camera.fy, camera.cx, camera.cy], 4).tolist(),
        "world_from_cam": camera.world_from_cam.round(7).tolist(),
    }
    depth_unit = result.depth_unit or known.depth_units.get(config.camera)
    if depth_unit is not None:
        entry["depth_unit"] = depth_unit
    content = {
        "units": "m",
        "workspace": asdict(workspace) | {"center": list(workspace.center)},
        "cameras": plain_calibration(known)["cameras"] | {config.camera: entry},
    }
    parse_calibration(content)
    if result.distortion.any():
        entry["distortion"] = result.distortion.round(8).tolist()
    config.output.parent.mkdir(parents=True, exist_ok=True)
    files = [config.output]
    if result.rgb is not None:
        files.append(config.output.with_name(f"{config.output.stem}_{config.camera}.png"))
        _picture(config, workspace, result).save(files[-1])
    _replace(config.output, _yaml(content))
    x, y, z = camera.position
    logger.info(
        "camera %r is at x %.3f, y %.3f, z %.3f m; wrote %s", config.camera, x, y, z, " and ".join(map(str, files))
    )
    return config.output


def _replace(file: Path, text: str) -> None:
    """Write a file at once."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(file.name + ".partial")
    part.write_text(text)
    part.replace(file)


def _picture(config: CalibrateConfig, workspace: Workspace, result: Result) -> Any:
    """Return the picture of a result, without its lens distortion: the drawn lines are straight."""
    rgb, corners, matrix = result.rgb, result.corners, result.camera.intrinsics
    assert rgb is not None
    if result.distortion.any():
        rgb = cv2.undistort(rgb, matrix, result.distortion)
        if corners is not None:
            corners = cv2.undistortPoints(corners[:, None], matrix, result.distortion, P=matrix)[:, 0]
    board = None if config.calibration else config.board.world_from_board
    return calibration_picture(rgb, result.camera, workspace, board, 2 * config.board.square, corners, result.caption)


def _yaml(content: dict[str, Any]) -> str:
    import yaml

    header = "# Written by symview-calibrate. Metres, OpenCV axes (x right, y down, z forward).\n"
    return header + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)


def _with_device() -> type[CalibrateConfig]:
    """Return the configuration with a LeRobot camera; LeRobot, which takes seconds to import, registers its types."""
    from lerobot.cameras import CameraConfig
    from lerobot.cameras.opencv import configuration_opencv  # noqa: F401
    from lerobot.cameras.realsense import configuration_realsense  # noqa: F401
    from lerobot.cameras.zmq import configuration_zmq  # noqa: F401
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()

    @dataclass(frozen=True)
    class CalibrateWithDeviceConfig(CalibrateConfig):
        device: CameraConfig | None = None

    CalibrateWithDeviceConfig.__annotations__["device"] = CameraConfig | None
    CalibrateWithDeviceConfig.__doc__ = CalibrateConfig.__doc__
    return CalibrateWithDeviceConfig


def main() -> None:
    """Run the console command."""
    live = any(argument.startswith("--device") for argument in sys.argv)
    run_command(
        _with_device() if live else CalibrateConfig,
        calibrate,
        EXAMPLES,
        short={"--root": "--dataset.root", **POSE_FLAGS},
    )
