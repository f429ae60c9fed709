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
from lerobot_symview.geometry.camera import Array

FAMILIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "ARUCO_ORIGINAL", "ARUCO_MIP_36h12",
            "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11")  # fmt: skip
LEAST_CORNERS = 6  # four determine a pose, and nothing would be left to check it
LEAST_MARKERS = 3  # of another dictionary, before it is named: single markers are found in any texture
SMALL_IMAGE = 1600  # pixels: smaller images are enlarged, so that markers of a dozen pixels are recognised
WINDOW = 0.8  # squares: half the side of the window in which the pattern is aligned
LARGEST_SHIFT = 0.3  # squares
LEAST_CORRELATION = 0.8  # of the pattern with the image; occluded corners have less
LEAST_INSIDE = 0.7  # of the window's area
LARGEST_SQUARE = 64  # pixels: enough for a hundredth of a pixel
ITERATIONS, CONVERGED = 20, 1e-3  # pixels


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

    The image is rectified to the pattern, and each corner's window is shifted to where it fits best (Lucas-Kanade).
    """
    image_from_board = _image_from_board(corners)
    outline = np.array([[[0, 0], [1, 0], [1, 1], [0, 1]]]) * board.size
    area = cv2.contourArea(cv2.perspectiveTransform(outline, image_from_board).astype(np.float32))
    in_image = board.square * np.sqrt(area / np.prod(board.size))  # pixels
    square = int(np.clip(in_image, 8, LARGEST_SQUARE))
    pattern = _pattern(board, square)
    step = board.square / square  # metres per pixel of the pattern
    board_from_pattern = np.array(
        [[step, 0, (0.5 - square) * step], [0, -step, board.size[1] - (0.5 - square) * step], [0, 0, 1]]
    )
    image_from_pattern = image_from_board @ board_from_pattern
    shape, inverse = pattern.shape[::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    smooth = grey.astype(np.float32)
    if in_image > square:  # the rectified image is coarser
        smooth = cv2.GaussianBlur(smooth, (0, 0), in_image / square / 2)
    rectified = cv2.warpPerspective(smooth, image_from_pattern, shape, flags=inverse)
    inside = cv2.warpPerspective(np.ones(grey.shape, np.float32), image_from_pattern, shape, flags=inverse)
    pattern, rectified = (cv2.GaussianBlur(image, (0, 0), 1.0) for image in (pattern, rectified))
    gradients = np.stack(np.gradient(pattern)[::-1])
    places = cv2.perspectiveTransform(board.corners[None, :, :2], np.linalg.inv(board_from_pattern))[0]
    half = round(WINDOW * square)
    found, located = [], []
    for index, place in enumerate(places):
        u, v = place.round().astype(int)
        window = np.s_[max(v - half, 0) : v + half + 1, max(u - half, 0) : u + half + 1]
        if inside[window].mean() < LEAST_INSIDE:
            continue
        shift = _shift(pattern[window], gradients[:, *window], rectified, inside[window], window)
        if shift is not None and np.linalg.norm(shift) < LARGEST_SHIFT * square:
            found.append(index)
            located.append(place + shift)
    if not found:
        return Corners(np.empty((0, 3)), np.empty((0, 2)))
    pixels = cv2.perspectiveTransform(np.array(located)[None], image_from_pattern)[0]
    return Corners(board.corners[found], pixels)


def _pattern(board: Board, square: int) -> NDArray[np.float32]:
    """Return the board's pattern with `square` pixels per square and a white border of one square.

    It is reduced from a finer one: markers seldom have a whole number of pixels.
    """
    side = pixels_per_square(board, 192, 384)
    fine = np.full((board.rows * side, board.columns * side), 255, dtype=np.float32)
    pattern = board_pattern(board, side)
    fine[: pattern.shape[0], : pattern.shape[1]] = pattern
    reduced = cv2.resize(fine, (board.columns * square, board.rows * square), interpolation=cv2.INTER_AREA)
    return np.pad(reduced, square, constant_values=255)


def _shift(
    template: NDArray, gradients: NDArray, image: NDArray, inside: NDArray, window: tuple[slice, slice]
) -> Array | None:
    """Return how far the template's content is shifted in the image, (2,) pixels; None if it is not there.

    Brightness and contrast of the image are free: both are eliminated from the template's gradients.
    """
    weight = np.sqrt(inside).ravel()[:, None]
    basis = np.linalg.qr(weight * np.column_stack([np.ones(template.size), template.ravel()]))[0]
    contrast = float(basis[:, 1] @ (weight[:, 0] * template.ravel()))
    slopes = weight * gradients.reshape(2, -1).T
    slopes -= basis @ (basis.T @ slopes)
    inverse = np.linalg.pinv(slopes)
    height, width = template.shape
    center = np.array([window[1].start + (width - 1) / 2, window[0].start + (height - 1) / 2])
    shift = np.zeros(2)
    for _ in range(ITERATIONS):
        sampled = cv2.getRectSubPix(image, (width, height), center + shift)
        values = weight[:, 0] * sampled.ravel()
        level, amplitude = basis.T @ values
        if amplitude * contrast <= 0:  # inverted or absent
            return None
        residuals = values - basis @ [level, amplitude]
        step = contrast / amplitude * (inverse @ residuals)
        shift -= step
        if np.linalg.norm(step) < CONVERGED:
            break
        if np.linalg.norm(shift) > min(height, width) / 2:
            return None
    explained = abs(amplitude) / np.hypot(amplitude, np.linalg.norm(residuals))
    return shift if explained >= LEAST_CORRELATION else None


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
        return (
            f"the image shows {corners} of the {len(board.corners)} corners and {len(ids)} of the {board.marker_count} "
            f"markers of the {board}, at least {LEAST_CORNERS} corners are needed: move the board or the light, and "
            "check its columns and rows"
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
