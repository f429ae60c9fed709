"""Real photographs of boards, which OpenCV's source archive ships with its own calibration of their cameras.

The archive is 95 MB: README.md of this folder says how to get it, and what was measured.
"""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.geometry.camera import transform
from symview_eval.calibrate.command import calibrate
from symview_eval.calibrate.config import CalibrateConfig, PrintedBoard

SAMPLES = Path(os.environ.get("OPENCV_SAMPLES", ""))
NUMBERS = (*range(1, 10), *range(11, 15))  # there is no left10.jpg
CHESSBOARD = PrintedBoard("chessboard", columns=10, rows=7, square=0.025)

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not os.environ.get("OPENCV_SAMPLES"), reason="OPENCV_SAMPLES is not opencv/samples/data"),
]


def entry(name):
    """An array of OpenCV's own calibration of the chessboard's camera."""
    storage = cv2.FileStorage(str(SAMPLES / "left_intrinsics.yml"), cv2.FILE_STORAGE_READ)
    return storage.getNode(name).mat()


def test_intrinsics_agree_with_opencv(tmp_path):
    output = calibrate(
        CalibrateConfig(CHESSBOARD, images=str(SAMPLES / "left[01]*.jpg"), output=tmp_path / "left.yaml")
    )
    camera, theirs = read_calibration(output).camera("front"), entry("camera_matrix")
    np.testing.assert_allclose([camera.fx, camera.fy], theirs[[0, 1], [0, 1]], rtol=0.005)
    np.testing.assert_allclose([camera.cx, camera.cy], theirs[:2, 2], atol=2)


@pytest.mark.parametrize(("index", "number"), list(enumerate(NUMBERS)))
def test_the_pose_of_each_photograph_agrees_with_opencv(tmp_path, index, number):
    """Relative to the board's centre, since OpenCV counts from another corner; left02 is their worst by far."""
    files = {"images": str(SAMPLES / f"left{number:02d}.jpg"), "intrinsics": str(SAMPLES / "left_intrinsics.yml")}
    output = calibrate(CalibrateConfig(CHESSBOARD, **files, output=tmp_path / "left.yaml"))
    cam_from_world = read_calibration(output).camera("front").cam_from_world
    turn, place = np.split(entry("extrinsic_parameters")[index], 2)
    rotation, _ = cv2.Rodrigues(turn)
    center = transform(cam_from_world, np.array([*CHESSBOARD.size, 0.0]) / 2)
    expected = rotation @ [4 * 0.025, 2.5 * 0.025, 0] + place  # of 9 x 6 corners, from the first
    assert np.linalg.norm(center - expected) < 0.0005
    tilt = np.rad2deg(np.arccos(min(1.0, -cam_from_world[:3, 2] @ rotation[:, 2])))  # their z points into the table
    assert tilt < (1.0 if number == 2 else 0.3)


def test_a_charuco_board_on_a_table(tmp_path, caplog):
    board = PrintedBoard("charuco", columns=5, rows=7, square=0.04, marker=0.02, dictionary="6X6_250")
    folder = SAMPLES / "aruco"
    files = {"images": str(folder / "choriginal.jpg"), "intrinsics": str(folder / "tutorial_camera_charuco.yml")}
    with caplog.at_level("INFO"):
        calibrate(CalibrateConfig(board, **files, output=tmp_path / "cameras.yaml"))
    assert "24 corners, reprojection error 0.1" in caplog.text
