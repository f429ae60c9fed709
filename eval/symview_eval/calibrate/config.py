"""Flags of `symview-calibrate`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from lerobot_symview.calibration.board import DICTIONARIES, Board
from lerobot_symview.calibration.readings import PoseReading
from lerobot_symview.calibration.writers import WRITERS
from lerobot_symview.geometry.units import parse_unit
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.registry import lookup
from lerobot_symview.runtime.cli import DatasetLocation


@dataclass(frozen=True)
class PrintedBoard(Board):
    """A board, and the file to print it from."""

    print: Path | None = None
    """Write the board as a .pdf or .png of its true size, and end."""


@dataclass(frozen=True)
class GripperPoint:
    """A point that is fixed to the gripper, by which the robot's own motions tell the camera's pose."""

    marker: int | None = None
    """Number of an ArUco marker on the gripper; the point is its centre. The dataset's state must have the gripper's
    pose: x, y, z, yaw, relative to the workspace's centre, or LeRobot's ee.x to ee.wz, in the frame of its base."""
    dictionary: str = "4X4_50"
    """Dictionary of the marker."""
    points: Path | None = None
    """CSV file of points picked by hand, in place of a marker: u, v (pixels), x, y, z (of the gripper in the world,
    metres), and wx, wy, wz (rotation vector) or yaw, if it turns."""
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Place of the point in the gripper's frame, metres, where the motions do not determine it."""

    def __post_init__(self) -> None:
        if self.dictionary not in DICTIONARIES:
            raise ValueError(f"unknown --gripper.dictionary {self.dictionary!r}, expected one such as 4X4_50")

    @property
    def is_given(self) -> bool:
        """Whether a marker or points are given."""
        return self.marker is not None or self.points is not None


@dataclass(frozen=True)
class CalibrateConfig:
    """Find a camera's pose, and its intrinsics if they are not known, from images of a printed board on the table.

    Writes the calibration, and beside it a picture with the workspace and the board's axes drawn into the image.
    """

    board: PrintedBoard = field(default_factory=PrintedBoard)
    """The board, its place on the table, and where to print it to."""
    gripper: GripperPoint = field(default_factory=GripperPoint)
    """A point on the gripper, in place of a board on the table."""
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
    """`fx,fy,cx,cy` in pixels, or a calibration file of any tool, with or without a pose. By default they are estimated
    from all images."""
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
    """Rows and columns of the camera's images, for `convert` and `gripper.points`, where the files do not say them."""
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
        if self.gripper.is_given and not self.intrinsics:
            raise ValueError("--gripper needs --intrinsics: fx,fy,cx,cy or a calibration file with the camera")
        if self.gripper.marker is not None and self.dataset is None:
            raise ValueError("--gripper.marker needs --dataset.repo_id: the gripper's poses are in its state")
        if self.depth_unit is not None:
            try:
                parse_unit(self.depth_unit)
            except ValueError as error:
                raise ValueError(f"--depth_unit: {error}") from None
