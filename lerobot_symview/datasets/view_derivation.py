"""Datasets with views: the columns that are rendered from a source's images."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from lerobot_symview import keys
from lerobot_symview.calibration.file import Calibration
from lerobot_symview.datasets.derivation import Derivation, Derive
from lerobot_symview.datasets.features import calibration_vectors
from lerobot_symview.datasets.frame_reader import FrameReader
from lerobot_symview.datasets.image_codec import encode_metres, encode_rgb
from lerobot_symview.datasets.image_statistics import ImageStatistics, constant_summary
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.state_reader import StateOrigin
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import View


@dataclass(frozen=True, kw_only=True)
class ViewDerivation(Derivation):
    """Settings of a dataset with views."""

    camera: str
    """Camera whose images the views are rendered from, and under whose name they are stored."""
    views: dict[str, View]
    """Views to add, by name."""
    workspace: Workspace
    """Square on the table that the views show."""
    calibration: Calibration | None
    """Calibration of the cameras that is not in the source; it is added to the result."""
    depth_units: dict[str, float]
    """Camera -> metres per unit of its depth; others as the source declares."""
    state_origin: StateOrigin | None
    """What the state's positions count from; None for the default of its names."""

    @property
    def reader(self) -> FrameReader:
        """Reader of the frames that the views are rendered from."""
        views, calibration = self.views.values(), self.calibration
        return FrameReader(
            self.open_source(), self.camera, self.workspace, views, calibration, self.depth_units, self.state_origin
        )

    @property
    def columns(self) -> list[str]:
        """Columns of the source that the views are rendered from."""
        return self.reader.columns()

    @property
    def image_kinds(self) -> dict[str, Literal["rgb", "height"]]:
        """`rgb` or `height` for every output of the views."""
        return {
            keys.view(self.camera, output): kind
            for view in self.views.values()
            for output, kind in view.outputs.items()
        }

    def deriver(self) -> Derive:
        """Return what renders the episodes of a part, with one reader."""
        return partial(self._render, self.reader)

    def _render(
        self, reader: FrameReader, episode: int, table: pa.Table
    ) -> tuple[dict[str, pa.Array], dict[str, ImageStatistics]]:
        """Render an episode; return its new columns and the statistics of its new images."""
        kinds, statistics = self.image_kinds, self.no_statistics()
        encoded: dict[str, list[bytes]] = {key: [] for key in kinds}
        renderers = [view.start_episode() for view in self.views.values()]
        for frame in reader.frames(episode, table):
            for render in renderers:
                for output, image in render(frame).items():
                    key = keys.view(self.camera, output)
                    statistics[key].add(image)
                    encoded[key].append(encode_rgb(image) if kinds[key] == "rgb" else encode_metres(image))
        columns = constant_columns(reader.given_cameras(), len(table))
        for key, images in encoded.items():
            columns[key] = image_column(images, "png" if kinds[key] == "rgb" else "tiff")
        return columns, statistics

    def vector_summaries(self, episodes: list[pa.Table]) -> dict[str, list[dict[str, Any]]]:
        """Return the statistics of the calibration that is added to the result."""
        return constant_summaries(self.reader.given_cameras(), list(map(len, episodes)))


def constant_columns(cameras: dict[str, Camera], frames: int) -> dict[str, pa.Array]:
    """Return the columns of the calibration of cameras that never move."""
    columns = {}
    for name, camera in cameras.items():
        for key, values in calibration_vectors(name, camera).items():
            columns[key] = pa.FixedSizeListArray.from_arrays(pa.array(np.tile(values, frames)), len(values))
    return columns


def constant_summaries(cameras: dict[str, Camera], lengths: list[int]) -> dict[str, list[dict[str, Any]]]:
    """Return the statistics of the calibration of cameras that never move: over the dataset, then each episode."""
    return {
        key: [constant_summary(values, length) for length in (sum(lengths), *lengths)]
        for name, camera in cameras.items()
        for key, values in calibration_vectors(name, camera).items()
    }


def image_column(images: list[bytes], extension: str) -> pa.StructArray:
    """Return encoded images as an image column of Hugging Face's `datasets`, with LeRobot's file names."""
    names = [f"frame-{index:06d}.{extension}" for index in range(len(images))]
    return pa.StructArray.from_arrays([pa.array(images, pa.binary()), pa.array(names)], ["bytes", "path"])
