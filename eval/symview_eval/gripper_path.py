"""The way of the gripper in an episode, drawn into images: a wrong base, unit or sign shows before training."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from lerobot_symview import keys
from lerobot_symview.datasets.frame_reader import FrameReader
from lerobot_symview.datasets.source import EpisodeTables, vectors
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.gripper_state import REQUIRED, gripper_columns
from lerobot_symview.geometry.workspace import Workspace
from symview_eval.contact_sheet import LINE, TILE, draw_line

logger = logging.getLogger(__name__)

PATH, HERE = (0, 170, 255), (255, 0, 200)  # RGB of the way, and of the gripper in the frame that is shown
MOST_POINTS = 300
DOT = 3.0  # pixels of a tile: radius of the gripper's dot
OUTSIDE = 0.5  # fraction of an episode outside the workspace that is reported


@dataclass(frozen=True, eq=False)
class GripperPath:
    """Where the gripper is in an episode.

    Args:
        points: (N, 3) one per frame, metres, in the calibration's world.
        workspace: the square on the table.
    """

    points: NDArray[np.floating]
    workspace: Workspace

    @property
    def outside(self) -> float:
        """Fraction of the frames in which the gripper is not over the workspace."""
        offset = np.abs(self.points[:, :2] - self.workspace.center)
        return float((offset > self.workspace.size / 2).any(axis=1).mean())

    @property
    def _way(self) -> NDArray[np.floating]:
        return self.points[np.unique(np.linspace(0, len(self.points) - 1, MOST_POINTS).round().astype(int))]

    def in_camera(self, rgb: NDArray[np.uint8], camera: Camera, index: int) -> NDArray[np.uint8]:
        """Draw the way, and the gripper of frame `index`, into a camera's image.

        Args:
            rgb: (s H, s W, 3) uint8, the image enlarged by a whole number.
            camera: the camera of the image of H rows.
            index: of the frame.
        """
        image = Image.fromarray(rgb)
        draw, scale = ImageDraw.Draw(image), rgb.shape[0] // camera.height
        width = max(1, round(LINE * max(image.size) / TILE))
        for start, end in zip(self._way, self._way[1:], strict=False):
            draw_line(draw, camera, scale, start, end, PATH, width)
        here = self.points[index]
        below = np.array([*here[:2], 0.0])
        draw_line(draw, camera, scale, below, here, HERE, width)  # how high it is
        return np.asarray(image)

    def on_view(self, rgb: NDArray[np.uint8], index: int) -> NDArray[np.uint8]:
        """Draw the way, and the gripper of frame `index`, onto a top-down view (H, H, 3) uint8: (s H, s H, 3)."""
        scale = max(1, round(2 * TILE / len(rgb)))
        image = Image.fromarray(rgb.repeat(scale, axis=0).repeat(scale, axis=1))
        draw, side = ImageDraw.Draw(image), len(rgb) * scale
        rows, columns = (((self._way[:, :2] - self.workspace.center) / self.workspace.size + 0.5) * side).T
        width = max(2, round(LINE * side / TILE))
        draw.line(list(zip(columns.tolist(), rows.tolist(), strict=True)), fill=PATH, width=width)
        row, column = ((self.points[index, :2] - self.workspace.center) / self.workspace.size + 0.5) * side
        radius = DOT * side / TILE
        draw.ellipse([column - radius, row - radius, column + radius, row + radius], fill=HERE)
        return np.asarray(image)


def read_path(reader: FrameReader, episode: int) -> GripperPath | None:
    """Return the gripper's way in an episode; None if the state does not say where it is."""
    points = gripper_points(reader, episode)
    if points is None:
        return None
    path = GripperPath(points, reader.workspace)
    if path.outside > OUTSIDE:
        logger.warning(
            "in %.0f %% of episode %d the gripper is not over the workspace: check what the state's positions count "
            "from, and the base's pose",
            100 * path.outside,
            episode,
        )
    return path


def gripper_points(reader: FrameReader, episode: int) -> NDArray[np.float64] | None:
    """Return where the gripper is in an episode (N, 3), metres, in the calibration's world; None if it is unknown."""
    try:
        states = reader.state_reader
    except CalibrationError as error:
        logger.warning("the gripper's path is not drawn: %s", error)
        return None
    columns = gripper_columns(states.read_names)
    if columns is None:
        return None
    source = reader.dataset
    table = EpisodeTables(source, source.data_file(episode), [keys.STATE]).read(episode)
    found = states.read(vectors(table, keys.STATE).astype(np.float64))
    points = found[:, [column for column in columns[: len(REQUIRED)] if column is not None]]
    points[:, :2] += reader.workspace.center
    return points
