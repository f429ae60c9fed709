"""`symview-calibrate --gripper`: the robot's own motions tell the camera's pose."""

import csv
import logging

import cv2
import numpy as np
import pytest
import yaml
from lerobot.datasets import LeRobotDataset
from scipy.spatial.transform import Rotation

from lerobot_symview import keys
from lerobot_symview.calibration.file import Calibration, plain_calibration
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.errors import SymviewError
from lerobot_symview.geometry.camera import Camera, orbit_pose, project
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import CommandError, DatasetLocation
from symview_eval.calibrate.command import calibrate
from symview_eval.calibrate.config import CalibrateConfig, GripperPoint
from tests.helpers.boards import K, pose_errors

CAMERA = Camera(K, orbit_pose(0.7, 0.4, 0.9, (0.45, 0.0, 0.1)), 480, 640)
POINT = np.array([0.02, 0.01, 0.04])
MARKER, SIDE = 7, 48  # number, and pixels in the image
FRAMES = 16
EE = ["ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz", "ee.gripper_pos"]
INTRINSICS = "615.3,615.1,319.5,239.5"


def motions(tilt):
    """Positions (N, 3) and rotation vectors (N, 3) of a gripper."""
    rng = np.random.default_rng(0)
    positions = [0.45, 0.0, 0.12] + rng.uniform(-1, 1, (FRAMES, 3)) * [0.12, 0.12, 0.08]
    yaw = rng.uniform(-1.5, 1.5, (FRAMES, 1)) * [0.0, 0.0, 1.0]
    tilts = rng.uniform(-tilt, tilt, (FRAMES, 2)) @ np.eye(2, 3)
    return positions, (Rotation.from_rotvec(tilts) * Rotation.from_rotvec(yaw)).as_rotvec()


def pixels_of(positions, turns):
    return project(positions + Rotation.from_rotvec(turns).apply(POINT), CAMERA)[0]


def photograph(pixel):
    """A grey image with the marker at a pixel, to a quarter of a pixel."""
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), MARKER, SIDE)
    marker = np.pad(marker, SIDE // 4, constant_values=255)
    shift = np.array([[1, 0, pixel[0] - (len(marker) - 1) / 2], [0, 1, pixel[1] - (len(marker) - 1) / 2]])
    image = cv2.warpAffine(marker, shift, (640, 480), borderValue=200)
    return np.repeat(image[..., None], 3, axis=-1)


def record(folder, names, states, images):
    state = {"dtype": "float32", "shape": (len(names),), "names": names}
    image = {"dtype": "image", "shape": (480, 640, 3), "names": ["height", "width", "channels"]}
    features = {keys.STATE: state, keys.ACTION: state, keys.rgb("front"): image}
    dataset = LeRobotDataset.create("test/arm", fps=10, root=folder, use_videos=False, features=features)
    for values, shown in zip(states.astype(np.float32), images, strict=True):
        dataset.add_frame({keys.STATE: values, keys.ACTION: values, keys.rgb("front"): shown, "task": "none"})
    dataset.save_episode()
    dataset.finalize()
    return DatasetLocation("test/arm", folder)


def config(folder, gripper, **options):
    return CalibrateConfig(
        gripper=gripper, camera="front", output=folder / "cameras.yaml", **{"intrinsics": INTRINSICS} | options
    )


def found(file):
    return pose_errors(CAMERA, read_calibration(file).camera("front").world_from_cam)


@pytest.mark.parametrize("names", [EE, [*keys.STATE_NAMES]], ids=["LeRobot's ee", "ours"])
def test_a_marker_on_the_gripper_gives_the_pose(tmp_path, caplog, names):
    positions, turns = motions(0.5 if names == EE else 0.0)
    pixels, opened = pixels_of(positions, turns), np.ones((FRAMES, 1))
    if names == EE:
        states, given = np.hstack([positions, turns, 100 * opened]), (0.0, 0.0, 0.0)
    else:
        states = np.hstack([positions - [*Workspace().center, 0.0], turns[:, 2:], opened])
        given = (0.0, 0.0, float(POINT[2]))  # the gripper only turns about the vertical
    images = [photograph(pixel) for pixel in pixels]
    images[3] = np.full((480, 640, 3), 200, np.uint8)
    images[5] = photograph(pixels[5] + [60, -40])
    dataset = record(tmp_path / "arm", names, states, images)
    with caplog.at_level(logging.INFO):
        file = calibrate(config(tmp_path, GripperPoint(MARKER, point=given), dataset=dataset, frames=FRAMES))
    degrees, millimetres = found(file)
    assert degrees < 0.3
    assert millimetres < 5
    assert f"marker 7 is in {FRAMES - 1} of {FRAMES} images" in caplog.text
    assert "frame 5: " in caplog.text
    assert ", left out" in next(line for line in caplog.messages if line.startswith("episode 0, frame 5"))
    assert ("turns about one axis only" in caplog.text) == (names != EE)
    assert (tmp_path / "cameras_front.png").exists()


def write_points(file, header, rows):
    with file.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(header)
        writer.writerows(rows.tolist())
    return file


def test_points_picked_by_hand_give_the_pose(tmp_path):
    positions, turns = motions(0.5)
    rows = np.hstack([pixels_of(positions, turns), positions, turns])
    file = write_points(tmp_path / "points.csv", ["u", "v", "x", "y", "z", "wx", "wy", "wz"], rows)
    gripper = GripperPoint(points=file)
    assert found(calibrate(config(tmp_path, gripper, image_size=(480, 640))))[1] < 1
    known = tmp_path / "lens.yaml"
    known.write_text(yaml.safe_dump(plain_calibration(Calibration({"front": CAMERA}))))
    assert found(calibrate(config(tmp_path, gripper, intrinsics=str(known))))[1] < 1


@pytest.mark.parametrize(
    ("header", "options", "message"),
    [
        (["u", "v", "x", "y"], {}, r"--gripper.points: .*points\.csv lacks the columns z; it has u, v, x, y"),
        (["u", "v", "x", "y", "z"], {"image_size": None}, "needs --image_size"),
        (["u", "v", "x", "y", "z"], {"intrinsics": ""}, "--gripper needs --intrinsics"),
    ],
)
def test_incomplete_points_are_refused(tmp_path, header, options, message):
    file = write_points(tmp_path / "points.csv", header, np.ones((9, len(header))))
    with pytest.raises((ValueError, SymviewError, CommandError), match=message):
        calibrate(config(tmp_path, GripperPoint(points=file), **{"image_size": (480, 640)} | options))
    assert not (tmp_path / "cameras.yaml").exists()


def test_a_state_of_joints_does_not_tell_the_gripper(tmp_path):
    names = [f"joint_{index}" for index in range(6)]
    dataset = record(tmp_path / "arm", names, np.zeros((2, 6)), [photograph((300, 200))] * 2)
    with pytest.raises(SymviewError, match=r"no dimensions x, y, z, yaw and no ee\.x.*it has joint_0"):
        calibrate(config(tmp_path, GripperPoint(MARKER), dataset=dataset, frames=2))


def test_a_marker_that_is_in_no_image_names_those_that_are(tmp_path):
    dataset = record(tmp_path / "arm", EE, np.zeros((2, 7)), [photograph((300, 200))] * 2)
    with pytest.raises(SymviewError, match=r"marker 3 of --gripper\.dictionary=4X4_50 is in none.*show the markers 7"):
        calibrate(config(tmp_path, GripperPoint(3), dataset=dataset, frames=2))


def test_a_marker_needs_a_dataset():
    with pytest.raises(ValueError, match=r"--gripper\.marker needs --dataset\.repo_id"):
        CalibrateConfig(gripper=GripperPoint(MARKER), intrinsics=INTRINSICS)
    with pytest.raises(ValueError, match=r"unknown --gripper\.dictionary"):
        GripperPoint(MARKER, "9X9")
