"""Calibration boards: their corners in an image, and their place on the table.

The board's frame lies in its print: the origin is the pattern's lower left corner, x points right, y up along the print
and z towards the viewer. `world_from_board` places it on the table.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_symview.errors import CalibrationError, OptionError
from lerobot_symview.geometry.camera import Array

DICTIONARIES = {name.removeprefix("DICT_"): getattr(cv2.aruco, name) for name in dir(cv2.aruco) if name[:5] == "DICT_"}
DEFAULT_DICTIONARY = {"charuco": "4X4_50", "chessboard": "", "apriltag": "APRILTAG_36h11"}
FAMILIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "ARUCO_ORIGINAL", "ARUCO_MIP_36h12",
            "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11")  # fmt: skip
LEAST_CORNERS = 6  # four determine a pose, and nothing would be left to check it
LEAST_MARKERS = 3  # of another dictionary, before it is named: single markers are found in any texture


@dataclass(frozen=True)
class Board:
    """A printed board that lies on the table.

    Raises:
        OptionError: if the board cannot exist, or a half turn does not change it.
    """

    type: str = "charuco"
    """charuco, chessboard or apriltag (a grid of AprilTags)."""
    columns: int = 7
    """Squares (charuco, chessboard) or tags (apriltag) along the board's x axis."""
    rows: int = 5
    """Squares or tags along the board's y axis."""
    square: float = 0.035
    """Side of a square, metres; of tags, the distance from one tag to the next, side and gap."""
    marker: float | None = None
    """Side of a marker with its black border, metres; by default three quarters of `square`."""
    dictionary: str = ""
    """The markers' dictionary, such as 5X5_100; by default 4X4_50 (charuco) or APRILTAG_36h11 (apriltag)."""
    origin: tuple[float, float] = (0.0, 0.0)
    """World x and y of the board's origin, the pattern's lower left corner, metres."""
    yaw_deg: float = 0.0
    """Angle from the world's x axis to the board's, degrees, counterclockwise seen from above."""
    height: float = 0.0
    """Height of the print above the table, such as the board's thickness, metres."""

    def __post_init__(self) -> None:
        if self.type not in DEFAULT_DICTIONARY:
            raise OptionError(f"type must be one of {', '.join(DEFAULT_DICTIONARY)}, got {self.type!r}")
        least = 1 if self.type == "apriltag" else 3
        if min(self.columns, self.rows) < least or self.columns * self.rows < 3:
            raise OptionError(f"columns and rows must be at least {least}, got {self.columns} and {self.rows}")
        lengths = np.array([self.square, self.marker_side, self.height, self.yaw_deg, *self.origin])
        if not (np.isfinite(lengths).all() and 0 < self.marker_side < self.square <= 1):
            raise OptionError(
                "square and marker are metres, at most 1, and a marker is smaller than its square; "
                f"got square {self.square:g} and marker {self.marker_side:g}"
            )
        if self.type == "chessboard" and (self.columns + self.rows) % 2 == 0:
            raise OptionError(
                f"a chessboard of {self.columns} x {self.rows} squares looks the same after half a turn, so its corner "
                "at the origin is unknown: use one with an even and an odd number of squares, or the type charuco"
            )
        if self.type != "chessboard":
            if self.dictionary_name not in DICTIONARIES:
                known = ", ".join(name for name in DICTIONARIES if not name.endswith(("H5", "H9", "H10", "H11", "H12")))
                raise OptionError(f"unknown dictionary {self.dictionary!r}, expected one of {known}")
            markers, available = self.marker_count, len(self._dictionary.bytesList)
            if markers > available:
                raise OptionError(
                    f"the board has {markers} markers and dictionary {self.dictionary_name} only {available}"
                )

    @property
    def marker_side(self) -> float:
        """Side of a marker, metres."""
        return 0.75 * self.square if self.marker is None else self.marker

    @property
    def dictionary_name(self) -> str:
        """Name of the dictionary in `DICTIONARIES`; empty for a chessboard."""
        return self.dictionary.removeprefix("DICT_") or DEFAULT_DICTIONARY[self.type]

    @property
    def marker_count(self) -> int:
        """Number of markers; the ids are 0 to this number, exclusive."""
        cells = self.columns * self.rows
        return {"charuco": cells // 2, "apriltag": cells, "chessboard": 0}[self.type]

    @property
    def corner_count(self) -> int:
        """Number of corners that an image of the whole board shows."""
        inner = (self.columns - 1) * (self.rows - 1)
        return 4 * self.columns * self.rows if self.type == "apriltag" else inner

    @property
    def size(self) -> tuple[float, float]:
        """Extent of the pattern along x and y, metres."""
        gap = self.square - self.marker_side if self.type == "apriltag" else 0.0
        return self.columns * self.square - gap, self.rows * self.square - gap

    @property
    def world_from_board(self) -> Array:
        """(4, 4) pose of the board on the table, metres."""
        cosine, sine = np.cos(np.deg2rad(self.yaw_deg)), np.sin(np.deg2rad(self.yaw_deg))
        x, y = self.origin
        return np.array([[cosine, -sine, 0, x], [sine, cosine, 0, y], [0, 0, 1, self.height], [0, 0, 0, 1]])

    @property
    def _dictionary(self) -> Any:
        return cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary_name])

    @cached_property
    def aruco(self) -> Any:
        """OpenCV's board; its axes are x right, y down along the print, from the upper left corner."""
        shape = (self.columns, self.rows)
        if self.type == "apriltag":
            return cv2.aruco.GridBoard(shape, self.marker_side, self.square - self.marker_side, self._dictionary)
        return cv2.aruco.CharucoBoard(shape, self.square, self.marker_side, self._dictionary)

    def __str__(self) -> str:
        cells = "tags" if self.type == "apriltag" else "squares"
        name = f" ({self.dictionary_name})" if self.dictionary_name else ""
        return f"{self.type} board of {self.columns} x {self.rows} {cells} of {1000 * self.square:g} mm{name}"


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
    corners = {"charuco": _charuco, "chessboard": _chessboard, "apriltag": _apriltags}[board.type](grey, board)
    if corners is None or len(corners) < LEAST_CORNERS:
        raise CalibrationError(_reason(grey, board, 0 if corners is None else len(corners)))
    if np.linalg.matrix_rank(corners.board - corners.board.mean(axis=0), tol=0.1 * board.square) < 2:
        raise CalibrationError(f"the {len(corners)} visible corners of the {board} lie on one line")
    return corners


def _charuco(grey: NDArray, board: Board) -> Corners | None:
    points, ids, _, _ = cv2.aruco.CharucoDetector(board.aruco).detectBoard(grey)
    if ids is None:
        return None
    return _corners(board, board.aruco.getChessboardCorners()[ids[:, 0]], points)


def _apriltags(grey: NDArray, board: Board) -> Corners | None:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    points, ids, _ = cv2.aruco.ArucoDetector(board._dictionary, parameters).detectMarkers(grey)
    if ids is None or ids.max() >= board.marker_count:
        return None
    return _corners(board, *board.aruco.matchImagePoints(points, ids))


def _chessboard(grey: NDArray, board: Board) -> Corners | None:
    """Find the inner corners and order them by the colours of the squares: OpenCV may begin at the opposite one."""
    columns, rows = board.columns - 1, board.rows - 1
    found, pixels = cv2.findChessboardCornersSB(
        grey, (columns, rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    )
    if not found:
        return None
    lattice = np.stack(np.meshgrid(np.arange(1, columns + 1), np.arange(1, rows + 1)), axis=-1).astype(float)
    pixels = pixels.reshape(rows, columns, 2)
    right, down = pixels[0, -1] - pixels[0, 0], pixels[-1, 0] - pixels[0, 0]
    if right[0] * down[1] < right[1] * down[0]:  # from behind; OpenCV's order is a reflection
        pixels = pixels[::-1]
    image_from_board, _ = cv2.findHomography(lattice.reshape(-1, 2), pixels.reshape(-1, 2))
    if _contrast(grey, image_from_board, board) < 0:  # the upper left square is white
        pixels = pixels[::-1, ::-1]
    return _corners(board, board.square * lattice, pixels)


def _contrast(grey: NDArray, image_from_lattice: Array, board: Board) -> float:
    """Return how much brighter the squares that should be white are than the others, in grey levels."""
    columns, rows = np.meshgrid(np.arange(1, board.columns - 1), np.arange(1, board.rows - 1))
    centres = np.stack([columns, rows], axis=-1).reshape(1, -1, 2) + 0.5
    pixels = cv2.perspectiveTransform(centres, image_from_lattice)[0].round().astype(int)
    inside = (pixels >= 0).all(axis=1) & (pixels < grey.shape[::-1]).all(axis=1)
    levels, white = grey[pixels[inside, 1], pixels[inside, 0]], ((columns + rows) % 2 == 1).ravel()[inside]
    return float(levels[white].mean() - levels[~white].mean())


def _corners(board: Board, points: Any, pixels: Any) -> Corners | None:
    """Return the corners at points with OpenCV's axes, (N, 2) or (N, 3), in the board's frame."""
    if pixels is None or len(pixels) == 0:
        return None
    points = np.asarray(points, dtype=np.float64)
    x, y = points[..., 0].ravel(), board.size[1] - points[..., 1].ravel()
    return Corners(np.column_stack([x, y, np.zeros_like(x)]), np.asarray(pixels, dtype=np.float64).reshape(-1, 2))


def _reason(grey: NDArray, board: Board, corners: int) -> str:
    """Return why a board is not found, as far as the image tells."""
    if board.type == "chessboard":
        return (
            f"no {board} is visible: all of its {board.corner_count} inner corners must be in the image, and its "
            "border white; a charuco board may be partly hidden"
        )
    ids = _marker_ids(grey, board._dictionary)
    foreign = [number for number in ids if number >= board.marker_count]
    if len(foreign) >= LEAST_MARKERS:
        return (
            f"the image shows {len(ids)} markers of {board.dictionary_name} with ids up to {max(ids)}, and the {board} "
            f"has ids up to {board.marker_count - 1}: check its columns and rows"
        )
    others = {name: _marker_ids(grey, cv2.aruco.getPredefinedDictionary(DICTIONARIES[name])) for name in FAMILIES}
    best = max(others, key=lambda name: len(others[name]))
    if len(others[best]) >= max(LEAST_MARKERS, len(ids) + 1):
        return f"no {board} is visible; the image shows {len(others[best])} markers of dictionary {_smallest(best, max(others[best]))}"
    if corners or ids:
        return (
            f"the image shows {corners} of the {board.corner_count} corners and {len(ids)} of the {board.marker_count} "
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
