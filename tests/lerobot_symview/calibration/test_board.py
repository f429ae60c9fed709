"""Boards are found in rendered photographs, give the camera's pose and intrinsics, or say why they cannot."""

import io
import re

import cv2
import numpy as np
import pytest
from PIL import Image

from lerobot_symview.calibration.board import Board
from lerobot_symview.calibration.board_corners import Corners, find_board
from lerobot_symview.calibration.board_pose import Intrinsics, board_pose, estimate_intrinsics, world_from_cam
from lerobot_symview.calibration.board_print import board_print, encode_print
from lerobot_symview.errors import CalibrationError, OptionError
from lerobot_symview.geometry.camera import Camera
from tests.helpers.boards import (
    K,
    camera_over,
    close_views,
    ideal_corners,
    photograph,
    pose_errors,
    random_camera,
)

BOARDS = {
    "charuco": Board(),
    "charuco of 5X5 markers": Board(columns=7, rows=5, square=0.05, marker=0.035, dictionary="5X5_100"),
    "chessboard": Board("chessboard", columns=8, rows=5, square=0.035),
    "apriltag": Board("apriltag", columns=5, rows=4, square=0.05),
}
PLACED = {"origin": (0.3, -0.1), "yaw_deg": 30.0, "height": 0.004}


def found_pose(board, image, intrinsics=None):
    pose = board_pose(find_board(image, board), intrinsics or Intrinsics(K), image.shape[1])
    return world_from_cam(pose, board.world_from_board), pose


@pytest.mark.parametrize("seed", range(50))
def test_a_rendered_board_gives_the_pose_to_a_millimetre_at_a_metre(seed):
    board = Board(**PLACED)
    camera = random_camera(board, np.random.default_rng(seed))
    pose, found = found_pose(board, photograph(board, camera, seed=seed))
    degrees, millimetres = pose_errors(camera, pose)
    assert degrees < 0.1
    assert millimetres < 1.0
    assert found.error_px < 0.1
    assert found.error_mm < 0.3


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", BOARDS)
def test_boards_of_every_type_give_the_pose(name, seed):
    board = BOARDS[name]
    camera = random_camera(board, np.random.default_rng(seed), elevation=(40, 80))
    degrees, millimetres = pose_errors(camera, found_pose(board, photograph(board, camera, seed=seed))[0])
    assert degrees < 0.1
    assert millimetres < 1.0


@pytest.mark.parametrize("roll", [0, 90, 180, 270])
@pytest.mark.parametrize("shape", [(8, 5), (7, 6), (5, 8)])
def test_the_colours_of_a_chessboard_tell_its_origin(shape, roll):
    board = Board("chessboard", *shape, square=0.03)
    camera = camera_over(board, 60, 20, 0.7, roll=roll)
    assert pose_errors(camera, found_pose(board, photograph(board, camera))[0])[0] < 0.1


def test_a_partly_hidden_board_gives_the_pose():
    board = Board()
    camera = camera_over(board, 60, 20, 0.7)
    image = photograph(board, camera)
    image[:, :300] = 90
    corners = find_board(image, board)
    assert 6 <= len(corners) < 15
    assert corners.pixels[:, 0].min() > 295
    assert pose_errors(camera, found_pose(board, image)[0])[0] < 0.2


def test_distortion_is_part_of_the_pose():
    board, distortion = Board(), np.array([-0.2, 0.08, 0.001, -0.0005])
    camera = camera_over(board, 55, 30, 0.6, offset=(0.1, 0.05))
    image = photograph(board, camera, distortion)
    corrected = pose_errors(camera, found_pose(board, image, Intrinsics(K, distortion))[0])
    assert corrected[0] < 0.1
    assert pose_errors(camera, found_pose(board, image)[0])[0] > 3 * corrected[0]


@pytest.mark.long
def test_twelve_views_give_intrinsics_and_distortion():
    board, distortion = Board(), (-0.2, 0.08, 0.001, -0.0005)
    views = {
        str(index): find_board(photograph(board, camera, distortion, seed=index), board)
        for index, camera in enumerate(close_views(board))
    }
    estimated = estimate_intrinsics(views, 480, 640)
    np.testing.assert_allclose(estimated.matrix, K, rtol=0.004, atol=2)
    np.testing.assert_allclose(estimated.distortion, distortion, atol=0.06)
    assert set(estimated.errors_px) == set(views)
    assert max(estimated.errors_px.values()) < 0.2
    camera = camera_over(board, 50, 10, 0.8)
    pose, _ = found_pose(board, photograph(board, camera, distortion), estimated)
    assert pose_errors(camera, pose)[1] < 5


@pytest.mark.parametrize("seed", range(4))
def test_a_pose_is_right_or_refused(seed):
    """Small boards, far away and noisy, at any angle: the corners may not determine the pose, but never mislead."""
    rng, board, accepted = np.random.default_rng(seed), Board(square=0.03), 0
    for index in range(50):
        camera = random_camera(board, rng, distance=rng.uniform(0.5, 4), elevation=(5, 90))
        try:
            pose = board_pose(ideal_corners(board, camera, noise=rng.uniform(0, 0.5), seed=index), Intrinsics(K), 640)
        except CalibrationError:
            continue
        accepted += 1
        assert pose_errors(camera, world_from_cam(pose, board.world_from_board))[0] < 5 * max(pose.uncertainty_deg, 0.1)
    assert accepted > 5


def refused_pose(camera, board, match, noise=0.0):
    with pytest.raises(CalibrationError, match=match):
        board_pose(ideal_corners(board, camera, noise), Intrinsics(K), 640)


def test_two_poses_that_fit_are_refused():
    far = camera_over(Board(), 60, 20, 30.0)
    telephoto = Camera(
        K * [[30], [30], [1]] + [[0, 0, -29 * 319.5], [0, 0, -29 * 239.5], [0, 0, 0]], far.world_from_cam, 480, 640
    )
    with pytest.raises(CalibrationError, match=r"two poses of the board, \d.* degrees apart"):
        board_pose(ideal_corners(Board(), telephoto, 0.05), Intrinsics(telephoto.intrinsics), 640)


def test_a_board_seen_edge_on_is_refused():
    refused_pose(camera_over(Board(), 5, 20, 0.6), Board(), "the board is seen edge on, 5 degrees above its plane")


def test_a_board_that_is_too_small_in_the_image_is_refused():
    refused_pose(camera_over(Board(), 89.9, 20, 3.0), Board(), "orientation uncertain by|two poses")


def test_corners_that_no_camera_sees_are_refused():
    refused_pose(camera_over(Board(), 60, 20, 0.7), Board(), r"the reprojection error is \d+\.\d+ pixels", noise=8)


def test_a_camera_from_above_is_accepted():
    camera = camera_over(Board(), 90, 0, 0.6)
    assert pose_errors(camera, found_pose(Board(), photograph(Board(), camera))[0])[0] < 0.1


def test_too_few_views_are_refused():
    views = {str(i): ideal_corners(Board(), camera) for i, camera in enumerate(close_views(Board(), 4))}
    with pytest.raises(CalibrationError, match=r"at least 5 images .* got 4"):
        estimate_intrinsics(views, 480, 640)


@pytest.mark.parametrize("elevation", [90, 60])
def test_parallel_views_do_not_determine_intrinsics(elevation):
    cameras = [
        camera_over(
            Board(),
            elevation,
            0,
            0.4 + 0.05 * i,
            offset=(0.02 * i - 0.05, 0.01 * i),
            roll=20 * i if elevation == 90 else 0,
        )
        for i in range(8)
    ]
    views = {str(i): ideal_corners(Board(), camera, noise=0.05, seed=i) for i, camera in enumerate(cameras)}
    with pytest.raises(CalibrationError, match=r"do not determine the intrinsics: .*leans to the left"):
        estimate_intrinsics(views, 480, 640)


def test_a_view_that_contradicts_the_others_is_named():
    views = {str(i): ideal_corners(Board(), camera, 0.05, i) for i, camera in enumerate(close_views(Board(), 30))}
    views["blurred"] = ideal_corners(Board(), close_views(Board())[0], noise=6)
    with pytest.raises(CalibrationError, match=r"reprojection error of blurred is \d\.\d+ pixels"):
        estimate_intrinsics(views, 480, 640)


def test_an_image_without_a_board_says_so():
    for board in BOARDS.values():
        with pytest.raises(CalibrationError, match="visible"):
            find_board(np.full((480, 640, 3), 120, np.uint8), board)


@pytest.mark.parametrize(
    ("shown", "expected", "match"),
    [
        (Board(dictionary="5X5_100"), Board(), "the image shows 12 markers of dictionary 5X5_50"),
        (Board("apriltag"), Board(), "markers of dictionary APRILTAG_36h11"),
        (Board(columns=9, rows=6, square=0.027), Board(), r"markers of 4X4_50 with ids up to 26.* check its columns"),
        (Board(), Board("chessboard", columns=9), "all of its 24 inner corners"),
    ],
)
def test_another_board_is_named(shown, expected, match):
    with pytest.raises(CalibrationError, match=match):
        find_board(photograph(shown, camera_over(shown, 70, 20, 0.5)), expected)


def test_the_pattern_of_old_boards_is_refused():
    old = Board()
    old.aruco.setLegacyPattern(True)
    with pytest.raises(CalibrationError, match=r"OpenCV before 4\.6 printed another pattern"):
        find_board(photograph(old, camera_over(old, 70, 20, 0.5)), Board())


def test_too_few_corners_are_refused():
    image = photograph(Board(), camera_over(Board(), 60, 20, 0.5))
    image[:, :370] = 90
    with pytest.raises(CalibrationError, match=r"at least 6 corners are needed|on one line"):
        find_board(image, Board())


def test_corners_on_a_line_are_refused(monkeypatch):
    line = Corners(Board().corners[:5], np.random.default_rng(0).random((5, 2)))
    corners = Corners(np.tile(line.board, (2, 1)), np.tile(line.pixels, (2, 1)))
    monkeypatch.setattr("lerobot_symview.calibration.board_corners._charuco", lambda *_: corners)
    with pytest.raises(CalibrationError, match="lie on one line"):
        find_board(np.zeros((48, 64), np.uint8), Board())


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"type": "checker"}, "charuco, chessboard, apriltag"),
        ({"type": "chessboard", "columns": 8, "rows": 6}, "looks the same after half a turn"),
        ({"type": "chessboard", "columns": 7, "rows": 5}, "looks the same after half a turn"),
        ({"columns": 2}, "at least 3"),
        ({"square": 30.0}, "metres"),
        ({"marker": 0.05}, "smaller than its square"),
        ({"dictionary": "9X9"}, "unknown dictionary"),
        ({"columns": 20, "rows": 20}, "200 markers and dictionary 4X4_50 only 50"),
    ],
)
def test_impossible_boards_are_refused(options, match):
    with pytest.raises(OptionError, match=match):
        Board(**options)


@pytest.mark.long
@pytest.mark.parametrize("name", BOARDS)
def test_a_board_is_printed_at_its_true_size(name):
    board = BOARDS[name]
    with Image.open(io.BytesIO(encode_print(board_print(board), ".png"))) as png:
        dpi, page = png.info["dpi"][0], np.asarray(png.convert("L"))
    small = cv2.resize(page, None, fx=1 / 12, fy=1 / 12, interpolation=cv2.INTER_AREA)
    corners = find_board(small, board)
    assert len(corners) == len(board.corners)
    metres = (corners.pixels + 0.5) * 12 / dpi * 0.0254
    difference = np.diff(metres - corners.board[:, :2] * [1, -1], axis=0)
    assert np.abs(difference).max() < 5e-5  # half a pixel of the print


def test_a_pdf_has_the_size_of_the_paper():
    content = encode_print(board_print(Board()), ".pdf")
    assert content.startswith(b"%PDF")
    width, height = map(float, re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", content).groups())
    assert (width / 72 * 25.4, height / 72 * 25.4) == pytest.approx((297, 210), abs=0.5)


def test_other_files_are_not_printed():
    with pytest.raises(OptionError, match=r"\.pdf or \.png"):
        encode_print(board_print(Board()), ".jpg")
