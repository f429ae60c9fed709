"""Calibration boards: their pattern and their place on the table.

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

from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.camera import Array

DICTIONARIES = {name.removeprefix("DICT_"): getattr(cv2.aruco, name) for name in dir(cv2.aruco) if name[:5] == "DICT_"}
DEFAULT_DICTIONARY = {"charuco": "4X4_50", "chessboard": "", "apriltag": "APRILTAG_36h11"}


@dataclass(frozen=True)
class Board:
    """A printed board that lies on the table.

    Raises:
        OptionError: if the board cannot exist, or a half turn does not change it.
    """

    type: str = "charuco"
    """charuco, chessboard or apriltag (a grid of AprilTags)."""
    columns: int = 6
    """Squares (charuco, chessboard) or tags (apriltag) along the board's x axis."""
    rows: int = 4
    """Squares or tags along the board's y axis."""
    square: float = 0.04
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
            markers, available = self.marker_count, len(self.markers.bytesList)
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

    @cached_property
    def corners(self) -> Array:
        """(N, 3) corners that are located in images, in the board's frame, metres: of squares inside, or of tags."""
        if self.type == "apriltag":
            return self.in_frame(np.concatenate(self.aruco.getObjPoints()))
        lattice = np.stack(np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows)), axis=-1)
        return self.in_frame(self.square * lattice.reshape(-1, 2))

    def in_frame(self, points: NDArray) -> Array:
        """Convert points (N, 2) or (N, 3) with the axes of `aruco` to the board's frame, (N, 3), metres."""
        x, y = points[:, 0].astype(np.float64), self.size[1] - points[:, 1].astype(np.float64)
        return np.column_stack([x, y, np.zeros_like(x)])

    @property
    def markers(self) -> Any:
        """OpenCV's dictionary."""
        return cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary_name])

    @cached_property
    def aruco(self) -> Any:
        """OpenCV's board; its axes are x right, y down along the print, from the upper left corner."""
        shape = (self.columns, self.rows)
        if self.type == "apriltag":
            return cv2.aruco.GridBoard(shape, self.marker_side, self.square - self.marker_side, self.markers)
        return cv2.aruco.CharucoBoard(shape, self.square, self.marker_side, self.markers)

    def __str__(self) -> str:
        cells = "tags" if self.type == "apriltag" else "squares"
        name = f" ({self.dictionary_name})" if self.dictionary_name else ""
        kind = self.type if self.type == "chessboard" else f"{self.type} board"
        return f"{kind} of {self.columns} x {self.rows} {cells} of {1000 * self.square:g} mm{name}"


def board_pattern(board: Board, square: int) -> NDArray[np.uint8]:
    """Return the board's pattern, (H, W) uint8, 0 or 255, without a border, with `square` pixels per square."""
    if board.type == "chessboard":
        white = np.indices((board.rows, board.columns)).sum(axis=0) % 2
        return (255 * white).astype(np.uint8).repeat(square, axis=0).repeat(square, axis=1)
    if board.type == "charuco":
        return board.aruco.generateImage((board.columns * square, board.rows * square), marginSize=0, borderBits=1)
    side = round(square * board.marker_side / board.square)
    gap = square - side
    pattern = np.full((board.rows * square - gap, board.columns * square - gap), 255, dtype=np.uint8)
    for number in range(board.marker_count):
        row, column = divmod(number, board.columns)
        marker = cv2.aruco.generateImageMarker(board.aruco.getDictionary(), number, side)
        pattern[row * square : row * square + side, column * square : column * square + side] = marker
    return pattern


def pixels_per_square(board: Board, low: int, high: int) -> int:
    """Return the pixels per square in [low, high] at which the edges of markers and their bits lie best on pixels."""
    if board.type == "chessboard":
        return high
    ratio, cells = board.marker_side / board.square, board.markers.markerSize + 2
    sides = np.arange(low, high + 1)[::-1]
    edges = np.stack([sides * ratio / cells, sides * (1 - ratio) / 2])
    return int(sides[np.argmin(np.abs(edges - edges.round()).max(axis=0).round(6))])
