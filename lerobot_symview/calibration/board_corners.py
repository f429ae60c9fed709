"""The corners of a calibration board in an image.

OpenCV finds and identifies the board. Its corners are then located by aligning the printed pattern around each of them
with the image, which uses all edges nearby and also finds corners whose markers were not recognised.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_symview.calibration.board import DICTIONARIES, Board, board_pattern, pixels_per_square
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Array, Camera
from lerobot_symview.geometry.undistortion import undistorted

FAMILIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "ARUCO_ORIGINAL", "ARUCO_MIP_36h12",
            "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11")  # fmt: skip
LEAST_CORNERS = 6  # four determine a pose, and nothing would be left to check it
LEAST_MARKERS = 3  # of another dictionary, before it is named: single markers are found in any texture
SMALL_IMAGE = 1600  # pixels: smaller images are enlarged, so that markers of a dozen pixels are recognised
WINDOW = 0.8  # squares: half the side of the window in which the pattern is aligned
LARGEST_SHIFT = 0.3  # squares
LEAST_CORRELATION = 0.8  # of the pattern with the image; occluded corners have less
LEAST_INSIDE = 0.7  # of the window's area
RENDERED_SQUARE = 96  # pixels
BLURS = (0.4, 0.7, 1.0, 1.4, 2.0, 3.0)  # pixels, standard deviations
ENLARGEMENT, SMOOTHING = 2, 3  # of the aligned windows: factor, and pixels of a Gaussian filter
ITERATIONS, CONVERGED = 30, 1e-7  # increase of the correlation


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of a board that an image shows.

    Args:
        board: (N, 3) float64, in the board's frame, metres; z = 0.
        pixels: (N, 2) float64, u and v in the image.
    """

    board: Array
    pixels: Array

    def __len__(self) -> int:
        return len(self.board)


def find_board(image: NDArray[np.uint8], board: Board) -> Corners:
    """Find the corners of a board in an image, with subpixel precision.

    Args:
        image: (H, W, 3) uint8 RGB or (H, W) uint8.
        board: the board that the image should show.

    Raises:
        CalibrationError: if it shows no board, another one, or too few of its corners.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    detected = {"charuco": _charuco, "chessboard": _chessboard, "apriltag": _apriltags}[board.type](grey, board)
    corners = detected
    for _ in range(2):  # the second time from a better homography
        corners = _aligned(grey, board, corners) if _spans_plane(corners, board) else corners
    if len(corners) < LEAST_CORNERS:
        raise CalibrationError(_reason(grey, board, len(corners)))
    if not _spans_plane(corners, board):
        raise CalibrationError(f"the {len(corners)} visible corners of the {board} lie on one line")
    return corners


def find_board_through_lens(image: NDArray[np.uint8], board: Board, matrix: Array, distortion: Array) -> Corners:
    """Find the corners of a board as `find_board` does, in an image of a known lens.

    Straight lines are straight in the undistorted image, in which the pattern fits around its corners; the corners are
    returned in the pixels of `image`.

    Args:
        image: (H, W, 3) uint8 RGB or (H, W) uint8.
        board: the board that the image should show.
        matrix: (3, 3) K in pixels.
        distortion: (N,) OpenCV's coefficients.
    """
    corners = find_board(cv2.undistort(image, matrix, distortion), board)
    rays = np.column_stack([corners.pixels, np.ones(len(corners))]) @ np.linalg.inv(matrix).T
    pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, distortion)
    return Corners(corners.board, pixels[:, 0])


def find_board_through_fisheye(image: NDArray[np.uint8], board: Board, camera: Camera) -> Corners:
    """Find the corners of a board as `find_board` does, in the image that a pinhole camera with the same K would take.

    The corners are ideal pixels; parts of the image beyond the pinhole's field of view are not searched.

    Args:
        image: (H, W, 3) uint8 RGB or (H, W) uint8.
        board: the board that the image should show.
        camera: of the image; its pose does not matter.
    """
    return find_board(undistorted(image, camera), board)


def _spans_plane(corners: Corners, board: Board) -> bool:
    if len(corners) < 4:
        return False
    return bool(np.linalg.matrix_rank(corners.board - corners.board.mean(axis=0), tol=0.5 * board.marker_side) == 2)


def _charuco(grey: NDArray, board: Board) -> Corners:
    parameters = cv2.aruco.CharucoParameters()
    parameters.minMarkers = 1
    enlarged, scale = _enlarged(grey)
    pixels, ids, _, _ = cv2.aruco.CharucoDetector(board.aruco, parameters, _detection()).detectBoard(enlarged)
    if ids is None:
        return Corners(np.empty((0, 3)), np.empty((0, 2)))
    return Corners(board.in_frame(board.aruco.getChessboardCorners()[ids[:, 0]]), _reduced(pixels, scale))


def _apriltags(grey: NDArray, board: Board) -> Corners:
    enlarged, scale = _enlarged(grey)
    pixels, ids, _ = cv2.aruco.ArucoDetector(board.markers, _detection()).detectMarkers(enlarged)
    known = [] if ids is None else [index for index, number in enumerate(ids[:, 0]) if number < board.marker_count]
    if not known:
        return Corners(np.empty((0, 3)), np.empty((0, 2)))
    points, pixels = board.aruco.matchImagePoints([pixels[index] for index in known], ids[known])
    return Corners(board.in_frame(points.reshape(-1, 3)), _reduced(pixels, scale))


def _detection() -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.minMarkerPerimeterRate = 0.015
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = 5, 35
    parameters.adaptiveThreshWinSizeStep = 6
    return parameters


def _enlarged(grey: NDArray) -> tuple[NDArray, int]:
    scale = 2 if max(grey.shape) < SMALL_IMAGE else 1
    return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC) if scale > 1 else grey, scale


def _reduced(pixels: Any, scale: int) -> Array:
    """Return pixels of an enlarged image, (N, 2), in the image's own coordinates."""
    return (np.asarray(pixels, dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5


def _chessboard(grey: NDArray, board: Board) -> Corners:
    """Find the inner corners and order them by the colours of the squares: OpenCV may begin at the opposite one."""
    columns, rows = board.columns - 1, board.rows - 1
    found, pixels = cv2.findChessboardCornersSB(grey, (columns, rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return Corners(np.empty((0, 3)), np.empty((0, 2)))
    pixels = np.asarray(pixels, dtype=np.float64).reshape(rows, columns, 2)
    right, down = pixels[0, -1] - pixels[0, 0], pixels[-1, 0] - pixels[0, 0]
    if right[0] * down[1] < right[1] * down[0]:  # reflected: a board is not seen from behind
        pixels = pixels[::-1]
    corners = Corners(board.corners, pixels.reshape(-1, 2))
    if _contrast(grey, board, corners) < 0:  # the upper left square would be white
        return Corners(board.corners, pixels[::-1, ::-1].reshape(-1, 2))
    return corners


def _contrast(grey: NDArray, board: Board, corners: Corners) -> float:
    """Return how much brighter the squares that should be white are than the others, in grey levels."""
    columns, rows = np.meshgrid(np.arange(1, board.columns - 1), np.arange(1, board.rows - 1))
    centres = board.in_frame(board.square * (np.stack([columns, rows], axis=-1).reshape(-1, 2) + 0.5))
    pixels = cv2.perspectiveTransform(centres[None, :, :2], _image_from_board(corners))[0].round().astype(int)
    levels, white = grey[pixels[:, 1], pixels[:, 0]].astype(float), ((columns + rows) % 2 == 1).ravel()
    return float(levels[white].mean() - levels[~white].mean())


def _image_from_board(corners: Corners) -> Array:
    """Return the homography (3, 3) from x and y in the board's frame to pixels."""
    homography, _ = cv2.findHomography(corners.board[:, :2], corners.pixels)
    return np.eye(3) if homography is None else homography


def _aligned(grey: NDArray, board: Board, corners: Corners) -> Corners:
    """Locate all corners of a board again, given some of them, and return those whose surroundings show the pattern.

    The pattern is rendered into the image, and the window of each corner is shifted to where it fits best.
    """
    image_from_board = _image_from_board(corners)
    image = grey.astype(np.float32)
    rendered = _rendered(board, image_from_board, image)
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * WINDOW * board.square
    places = cv2.perspectiveTransform(board.corners[None, :, :2], image_from_board)[0]
    found, located = [], []
    for index, (corner, place) in enumerate(zip(board.corners[:, :2], places, strict=True)):
        outline = cv2.perspectiveTransform((corner + square)[None], image_from_board)[0]
        first = np.maximum(np.floor(outline.min(axis=0)).astype(int), 0)
        last = np.minimum(np.ceil(outline.max(axis=0)).astype(int), np.array(grey.shape[::-1]) - 1)
        if (last < first).any():
            continue
        inside = np.zeros((last - first + 1)[::-1], np.uint8)
        cv2.fillConvexPoly(inside, (outline - first).round().astype(np.int32), 1)
        side = np.sqrt(cv2.contourArea(outline.astype(np.float32))) / (2 * WINDOW)  # pixels of a square
        if inside.sum() < LEAST_INSIDE * (2 * WINDOW * side) ** 2:
            continue
        window = np.s_[first[1] : last[1] + 1, first[0] : last[0] + 1]
        shift = _shift(image[window], rendered[window], inside)
        if shift is not None and np.linalg.norm(shift) < LARGEST_SHIFT * side:
            found.append(index)
            located.append(place + shift)
    return Corners(board.corners[found], np.array(located).reshape(-1, 2))


def _rendered(board: Board, image_from_board: Array, image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the image (H, W) of the board alone, as sharp as `image`, from the homography of its print."""
    outline = np.array([[[0, 0], [1, 0], [1, 1], [0, 1]]]) * board.size
    area = cv2.contourArea(cv2.perspectiveTransform(outline, image_from_board).astype(np.float32))
    in_image = board.square * np.sqrt(area / np.prod(board.size))  # pixels
    samples = int(np.clip(round(RENDERED_SQUARE / max(in_image, 1)), 1, 4))  # per pixel and axis
    side = pixels_per_square(board, RENDERED_SQUARE, 2 * RENDERED_SQUARE)
    pattern = np.pad(board_pattern(board, side), side, constant_values=255).astype(np.float32)
    step = board.square / side
    edge = (0.5 - side) * step
    board_from_pattern = np.array([[step, 0, edge], [0, -step, board.size[1] - edge], [0, 0, 1]])
    fine_from_image = np.array([[samples, 0, (samples - 1) / 2], [0, samples, (samples - 1) / 2], [0, 0, 1]])
    size = np.array(image.shape[::-1])
    fine = cv2.warpPerspective(
        cv2.GaussianBlur(pattern, (0, 0), max(0.5, side / (samples * in_image) / 2)),
        fine_from_image @ image_from_board @ board_from_pattern,
        samples * size,
        borderValue=255,
    )
    ideal = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
    mask = cv2.warpPerspective(
        np.ones_like(pattern), image_from_board @ board_from_pattern, size, flags=cv2.INTER_NEAREST
    )
    candidates = [cv2.GaussianBlur(ideal, (0, 0), blur) for blur in BLURS]
    seen = image[mask > 0]
    return max(candidates, key=lambda candidate: float(np.corrcoef(candidate[mask > 0], seen)[0, 1]))


def _shift(image: NDArray[np.float32], rendered: NDArray[np.float32], inside: NDArray[np.uint8]) -> Array | None:
    """Return how far a window's content is shifted in the image, (2,) pixels; None if the image does not show it.

    Args:
        image: (h, w) window of the image.
        rendered: (h, w) the same window of the rendered board.
        inside: (h, w) where `rendered` counts, 0 or 1.
    """
    # OpenCV interpolates linearly, which blurs; in enlarged windows the corners are twice as precise
    image, rendered = (
        cv2.resize(part, None, fx=ENLARGEMENT, fy=ENLARGEMENT, interpolation=cv2.INTER_CUBIC)
        for part in (image, rendered)
    )
    inside = inside.repeat(ENLARGEMENT, axis=0).repeat(ENLARGEMENT, axis=1)
    rendered_from_image = np.eye(2, 3, dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, ITERATIONS, CONVERGED)
    try:
        correlation, rendered_from_image = cv2.findTransformECC(
            image, rendered, rendered_from_image, cv2.MOTION_TRANSLATION, criteria, inside, SMOOTHING
        )
    except cv2.error:  # they have nothing in common
        return None
    shift: Array = -rendered_from_image[:, 2].astype(np.float64) / ENLARGEMENT
    return shift if correlation >= LEAST_CORRELATION else None


def _reason(grey: NDArray, board: Board, corners: int) -> str:
    """Return why a board is not found, as far as the image tells."""
    if board.type == "chessboard":
        return (
            f"no {board} is visible: all of its {len(board.corners)} inner corners must be in the image, and its "
            "border white; a charuco board may be partly hidden"
        )
    ids = _marker_ids(grey, board.markers)
    foreign = [number for number in ids if number >= board.marker_count]
    if len(foreign) >= LEAST_MARKERS:
        return (
            f"the image shows {len(ids)} markers of {board.dictionary_name} with ids up to {max(ids)}, and the {board} "
            f"has ids up to {board.marker_count - 1}: check its columns and rows"
        )
    others = {name: _marker_ids(grey, cv2.aruco.getPredefinedDictionary(DICTIONARIES[name])) for name in FAMILIES}
    best = max(others, key=lambda name: len(others[name]))
    if len(others[best]) >= max(LEAST_MARKERS, len(ids) + 1):
        name = _smallest(best, max(others[best]))
        return f"no {board} is visible; the image shows {len(others[best])} markers of dictionary {name}"
    if corners or ids:
        old = board.type == "charuco" and board.rows % 2 == 0 and 2 * len(ids) > board.marker_count
        hint = "; with an even number of rows, OpenCV before 4.6 printed another pattern" if old else ""
        return (
            f"the image shows {corners} of the {len(board.corners)} corners and {len(ids)} of the {board.marker_count} "
            f"markers of the {board}, at least {LEAST_CORNERS} corners are needed: move the board or the light, and "
            f"check its columns and rows{hint}"
        )
    return f"no {board} and no other markers are visible: is it in the image, sharp and unmirrored?"


def _marker_ids(grey: NDArray, dictionary: Any) -> list[int]:
    _, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(grey)
    return [] if ids is None else sorted(int(number) for number in ids.ravel())


def _smallest(family: str, largest_id: int) -> str:
    """Return the smallest dictionary of a family, such as 5X5_1000, that has a marker of this id."""
    stem, _, count = family.rpartition("_")
    if not count.isdigit():
        return family
    return next(f"{stem}_{size}" for size in (50, 100, 250, 1000) if largest_id < size)
