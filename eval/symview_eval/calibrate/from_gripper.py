"""A camera's calibration from a marker, or any point, on the robot's gripper (eye to hand)."""

from __future__ import annotations

import csv
import logging
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_symview import keys
from lerobot_symview.calibration.board import DICTIONARIES
from lerobot_symview.calibration.hand_eye import HandEye, hand_eye
from lerobot_symview.datasets.features import Features
from lerobot_symview.datasets.source import SourceDataset, vectors
from lerobot_symview.errors import CalibrationError, DatasetError
from lerobot_symview.geometry.camera import Array
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import flagged
from symview_eval.calibrate.config import CalibrateConfig
from symview_eval.calibrate.from_board import given_camera
from symview_eval.calibrate.output import Result
from symview_eval.calibrate.photographs import Photographs, chosen_frames, from_dataset, rows

logger = logging.getLogger(__name__)

EE_NAMES = ["ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz"]  # LeRobot's, in the frame of the robot's base
POINT_COLUMNS = ("u", "v", "x", "y", "z")


def from_gripper(config: CalibrateConfig, workspace: Workspace) -> Result:
    """Return the camera from where it sees a point of the gripper, at known poses of the gripper.

    Raises:
        CalibrationError: if the poses do not determine it.
    """
    images: Photographs = {}
    if config.gripper.points is not None:
        with flagged("--gripper.points"):
            poses, pixels, names = read_points(config.gripper.points)
        size: tuple[int, ...] | None = config.image_size
    else:
        assert config.dataset is not None
        assert config.gripper.marker is not None
        wanted = config.gripper.marker
        with flagged("--dataset, --camera, --episodes"):
            folder = config.dataset.folder()
            images = from_dataset(folder, config.camera, config.episodes, config.frames)
            markers = {name: _markers(image, config) for name, image in images.items()}
            found = {name: seen[wanted] for name, seen in markers.items() if wanted in seen}
            logger.info("marker %d is in %d of %d images", wanted, len(found), len(images))
            if not found:
                others = sorted({number for seen in markers.values() for number in seen})
                raise CalibrationError(
                    f"marker {wanted} of --gripper.dictionary={config.gripper.dictionary} is in none of the images; "
                    f"they show the markers {', '.join(map(str, others)) or '(none)'}"
                )
            poses = gripper_poses(folder, config.episodes, config.frames, list(found), workspace)
        pixels, names = np.array(list(found.values())).reshape(-1, 2), list(found)
        size = next(iter(images.values())).shape[:2]
    camera = given_camera(config, size)
    with flagged("--gripper, --intrinsics"):
        result = hand_eye(camera, poses, pixels, config.gripper.point)
    _report(result, names)
    shown = names[int(np.argmax(result.used))]
    caption = (
        f"{result.used.sum()} poses of the gripper, {np.sqrt(np.mean(result.errors_px[result.used] ** 2)):.1f} px, "
        f"{np.sqrt(np.mean(result.errors_mm[result.used] ** 2)):.1f} mm"
    )
    return Result(result.camera, images.get(shown), pixels[names.index(shown)][None], caption)


def _report(result: HandEye, names: list[str]) -> None:
    for name, millimetres, used in zip(names, result.errors_mm, result.used, strict=True):
        logger.info("%s: %.1f mm%s", name, millimetres, "" if used else ", left out")
    logger.info(
        "%d of %d poses agree; camera's orientation ± %.2f°, position ± %.1f mm; the point is at %s m on the gripper",
        result.used.sum(),
        len(names),
        result.uncertainty_deg,
        result.uncertainty_mm,
        np.round(result.point, 4).tolist(),
    )
    if result.fixed is not None:
        logger.warning(
            "the gripper turns about one axis only, %s in its frame: the point's place along it is not determined and "
            "taken from --gripper.point; an error there shifts the camera as much. --refine=table corrects its height",
            np.round(result.fixed, 2).tolist(),
        )


def read_points(file: Path) -> tuple[Array, Array, list[str]]:
    """Read points picked by hand from a CSV file.

    Its header names the columns: u, v, pixels; x, y, z, the gripper's position in the world, metres; and, if it turns,
    its rotation vector wx, wy, wz or its yaw, radians.

    Returns:
        Poses of the gripper (N, 4, 4), pixels (N, 2), and names of the rows.

    Raises:
        CalibrationError: if a column is missing, or an entry is no number.
    """
    try:
        lines = list(csv.DictReader(file.read_text().splitlines(), skipinitialspace=True))
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"cannot read {file}: {error}") from None
    columns = list(lines[0]) if lines else []
    missing = [name for name in POINT_COLUMNS if name not in columns]
    if missing:
        raise CalibrationError(f"{file} lacks the columns {', '.join(missing)}; it has {', '.join(columns) or 'none'}")
    turning = [name for name in ("wx", "wy", "wz") if name in columns] or [name for name in ("yaw",) if name in columns]
    try:
        numbers = np.array([[float(line[name]) for name in (*POINT_COLUMNS, *turning)] for line in lines])
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{file}: {error}") from None
    if not np.isfinite(numbers).all():
        raise CalibrationError(f"{file} has numbers that are not finite")
    return _poses(numbers[:, 2:5], numbers[:, 5:]), numbers[:, :2], [f"row {row + 2}" for row in range(len(lines))]


def gripper_poses(folder: Path, episodes: list[int], frames: int, chosen: list[str], workspace: Workspace) -> Array:
    """Return world_from_gripper (N, 4, 4) of a dataset's frames, by the names of their images, from the state.

    Raises:
        DatasetError: if the state does not tell it.
    """
    source = SourceDataset(folder)
    columns, is_ours = _pose_columns(source.features)
    poses = {}
    for episode in episodes:
        states = vectors(rows(source, keys.STATE, episode), keys.STATE)
        for name, index in chosen_frames(episode, len(states), frames).items():
            state = states[index].astype(np.float64)[columns]
            offset = [*workspace.center, 0.0] if is_ours else np.zeros(3)
            poses[name] = _poses(state[None, :3] + offset, state[None, 3:])[0]
    return np.array([poses[name] for name in chosen]).reshape(-1, 4, 4)


def _pose_columns(features: Features) -> tuple[list[int], bool]:
    """Return the indices of position and turn in the state, and whether positions are relative to the workspace."""
    names = features.get(keys.STATE, {}).get("names") or []
    pose = keys.STATE_NAMES[:4]
    if set(pose) <= set(names):
        return [names.index(name) for name in pose], True
    if not set(EE_NAMES) <= set(names):
        raise DatasetError(
            f"{keys.STATE} has no dimensions {', '.join(keys.STATE_NAMES[:4])} and no {', '.join(EE_NAMES)}; it has "
            f"{', '.join(map(str, names)) or 'no names'}"
        )
    return [names.index(name) for name in EE_NAMES], False


def _poses(positions: Array, turns: Array) -> Array:
    """Return poses (N, 4, 4) from positions (N, 3) and rotation vectors (N, 3), yaws (N, 1), or nothing (N, 0)."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    if turns.shape[1] == 1:
        turns = turns * [0.0, 0.0, 1.0]
    if turns.shape[1] == 3:
        poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    return poses


def _markers(image: NDArray[np.uint8], config: CalibrateConfig) -> dict[int, Array]:
    """Return number -> pixel of the centre, where the diagonals cross, of the markers that an image shows once."""
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[config.gripper.dictionary])
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(
        cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    )
    numbers = [] if ids is None else [int(number) for number in ids.ravel()]
    centers = {}
    for number, square in zip(numbers, corners, strict=True):
        if numbers.count(number) == 1:
            first, second, third, fourth = np.column_stack([square[0].astype(np.float64), np.ones(4)])
            crossing = np.cross(np.cross(first, third), np.cross(second, fourth))
            centers[number] = crossing[:2] / crossing[2]
    return centers
