"""Reader of a LeRobot dataset on disk, by episode.

This module returns depth in float32 metres for any stored unit. Tables are read with pyarrow; LeRobot, which takes
seconds to import, is used for videos only.
"""

from __future__ import annotations

import logging
from collections.abc import Buffer, Collection, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pyarrow.compute import struct_field

from lerobot_symview.datasets.features import Features, declared_unit, is_depth_feature
from lerobot_symview.datasets.image_codec import decode_depth, decode_rgb, encoded_size
from lerobot_symview.datasets.metadata import ADDED_VIEWS, is_count, pixels, read_info, read_settings
from lerobot_symview.errors import DatasetError
from lerobot_symview.geometry.units import ABOVE_MINIMUM, METRES, MILLIMETRES, in_metres, infer_depth_unit, unit_name

logger = logging.getLogger(__name__)

ROW_BYTES = 2**20  # largest size of a table's row, without its images
VIDEO_FRAMES = 64  # frames decoded per batch
VIDEO_TOLERANCE = 1e-4  # seconds, as in LeRobot


class SourceDataset:
    """A LeRobot dataset in a folder.

    Args:
        folder: the dataset's root.

    Raises:
        DatasetError: if the dataset is missing, has another format or is malformed.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.info = read_info(folder)
        self._units: dict[str, float] = {}

    @property
    def features(self) -> Features:
        """Feature declarations from `meta/info.json`."""
        return self.info["features"]

    @cached_property
    def added_views(self) -> dict[str, Any]:
        """What `symview-add-views` was told when it made the dataset; empty for other datasets."""
        return read_settings(self.folder, ADDED_VIEWS)

    @cached_property
    def episodes(self) -> list[dict[str, Any]]:
        """Metadata of every episode from `meta/episodes`, in order, without statistics."""
        files = sorted((self.folder / "meta" / "episodes").rglob("*.parquet"))
        count = sum(pq.read_metadata(file).num_rows for file in files)
        if count != self.info["total_episodes"]:
            raise DatasetError(
                f"{self.folder / 'meta' / 'episodes'} has {count} rows, total_episodes is {self.info['total_episodes']}"
            )
        rows = []
        for file in files:
            names = [name for name in pq.read_schema(file).names if not name.startswith("stats/")]
            rows += pq.read_table(file, columns=names).to_pylist()
        rows.sort(key=lambda row: row["episode_index"] if is_count(row.get("episode_index"), 0) else -1)
        self._check_episodes(rows)
        return rows

    def _check_episodes(self, rows: list[dict[str, Any]]) -> None:
        """Raise a DatasetError unless the rows are consecutive episodes with integer indices within `total_frames`."""
        frames, end = self.info["total_frames"], 0
        for index, row in enumerate(rows):
            bounds = {
                "episode_index": (index, index),
                "length": (1, frames),
                "dataset_from_index": (end, frames - 1),
                "data/chunk_index": (0, None),
                "data/file_index": (0, None),
            }
            bounds |= {name: (0, None) for name in row if name.startswith("videos/") and name.endswith("_index")}
            for name, (least, most) in bounds.items():
                value = row.get(name)
                if not is_count(value, least) or (most is not None and value > most):
                    upper = "" if most is None else f" to {most}"
                    raise DatasetError(
                        f"{self.folder / 'meta' / 'episodes'}: episode {index} has {name} {value!r}, "
                        f"expected an integer from {least}{upper}"
                    )
            end = row["dataset_from_index"] + row["length"]

    def data_file(self, episode: int) -> Path:
        """Return the file of an episode's table."""
        return self.folder / self.data_path(*self.file_index(episode))

    def file_index(self, episode: int) -> tuple[int, int]:
        """Return the chunk index and file index of an episode's table."""
        row = self.episodes[episode]
        return row["data/chunk_index"], row["data/file_index"]

    def data_path(self, chunk: int, file: int) -> str:
        """Return the path of a table, relative to the dataset."""
        return self.info["data_path"].format(chunk_index=chunk, file_index=file)

    def first_row(self, episode: int) -> int:
        """Return the index of an episode's first row in its table file."""
        return self.episodes[episode]["dataset_from_index"] - self._file_starts[self.file_index(episode)]

    @cached_property
    def _file_starts(self) -> dict[tuple[int, int], int]:
        starts: dict[tuple[int, int], int] = {}
        for episode, row in enumerate(self.episodes):
            starts.setdefault(self.file_index(episode), row["dataset_from_index"])
        return starts

    def video_file(self, key: str, episode: int) -> Path:
        """Return the video file of an episode and a video feature.

        Raises:
            DatasetError: if the metadata lacks the location.
        """
        row, template = self.episodes[episode], self.info["video_path"]
        places = {part: row.get(f"videos/{key}/{part}") for part in ("chunk_index", "file_index")}
        if template is None or None in places.values():
            raise DatasetError(f"{self.folder / 'meta'} lacks the location of the video of {key} in episode {episode}")
        return self.folder / template.format(video_key=key, **places)

    def check_files(self, features: Collection[str]) -> None:
        """Raise a DatasetError that lists missing files of the given features, over all episodes."""
        videos = [key for key in features if self.features[key]["dtype"] == "video"]
        files = {self.folder / "meta" / "stats.json": None}
        files |= {self.folder / self.data_path(*place): None for place in self._file_starts}
        for episode in range(len(self.episodes)):
            files |= dict.fromkeys(self.video_file(key, episode) for key in videos)
        missing = [str(file.relative_to(self.folder)) for file in files if not file.is_file()]
        if missing:
            more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
            raise DatasetError(
                f"the dataset in {self.folder} lacks {', '.join(missing[:3])}{more}: download or copy it again"
            )

    def images(self, key: str, episode: int, table: pa.Table, depth_unit: float | None = None) -> Iterator[NDArray]:
        """Decode an image or video feature: (H, W, 3) uint8 colour, or (H, W) float32 depth or height, metres.

        Args:
            key: key of the feature.
            episode: index of the episode.
            table: rows of the episode; one image is decoded per row.
            depth_unit: metres per unit of a depth feature; by default as in `depth_unit`. In a video, of the integers
                that were encoded: LeRobot takes them for millimetres.
        """
        feature = self.features[key]
        if feature["dtype"] == "video":
            scale = 1.0 if depth_unit is None else depth_unit / MILLIMETRES
            for image in self._video_frames(key, episode, table["timestamp"].to_numpy()):
                yield image if scale == 1 else image * np.float32(scale)
            return
        encoded, paths = (struct_field(table[key], part) for part in ("bytes", "path"))
        for index, image in enumerate(encoded):
            data = image.as_buffer()
            if data is None:
                raise ValueError(f"{key}: expected an image in the table, got none; its path is {paths[index]}")
            yield self.decode(key, data, depth_unit)

    def decode(self, key: str, data: Buffer, depth_unit: float | None = None) -> NDArray:
        """Decode one image of an image feature, as `images` yields it."""
        feature = self.features[key]
        self._check_size(key, *encoded_size(data))
        if not is_depth_feature(feature):
            return decode_rgb(data)
        return in_metres(decode_depth(data), depth_unit or self.depth_unit(key)).astype(np.float32, copy=False)

    def depth_unit(self, key: str) -> float:
        """Return the metres per unit of a stored depth or height feature.

        This is the declared unit (`info["depth_unit"]`). An undeclared unit is inferred from the values of the first
        image with a valid pixel, and logged.
        """
        if key not in self._units:
            self._units[key] = declared_unit(self.features[key]) or self._inferred_unit(key)
        return self._units[key]

    def _inferred_unit(self, key: str) -> float:
        stored = self.first_depth(key)
        unit = METRES if stored is None else infer_depth_unit(stored[1])
        logger.info("%s declares no depth_unit: its values are taken to be %s", key, unit_name(unit))
        return unit

    def first_depth(self, key: str) -> tuple[int, NDArray] | None:
        """Return the first stored depth image of episode 0 with a valid pixel, as stored, and its frame's index."""
        table = EpisodeTables(self, self.data_file(0), [key]).read(0)
        for index, encoded in enumerate(struct_field(table[key], "bytes")):
            depth = decode_depth(encoded.as_buffer())
            if (depth > 0).any():
                return index, depth
        return None

    def _check_size(self, key: str, height: int, width: int) -> None:
        shape = self.features[key]["shape"]
        if height * width > pixels(shape):
            declared = " x ".join(map(str, shape))
            raise ValueError(f"{key}: an image has {height} x {width} pixels, the dataset declares {declared}")

    def _video_frames(self, key: str, episode: int, timestamps: NDArray[np.floating]) -> Iterator[NDArray]:
        import av
        from lerobot.configs.video import DepthEncoderConfig
        from lerobot.datasets.depth_utils import dequantize_depth
        from lerobot.datasets.video_utils import decode_video_frames

        row, info = self.episodes[episode], self.features[key].get("info") or {}
        file = self.video_file(key, episode)
        with av.open(str(file)) as container:
            stream = container.streams.video[0]
            self._check_size(key, stream.height, stream.width)
            rate = float(stream.average_rate)
        is_depth = is_depth_feature(self.features[key])
        for first in range(0, len(timestamps), VIDEO_FRAMES):
            seconds = (row[f"videos/{key}/from_timestamp"] + timestamps[first : first + VIDEO_FRAMES]).tolist()
            between = (max(seconds) - min(seconds)) * rate
            if not between < 2 * VIDEO_FRAMES:
                raise DatasetError(
                    f"{file}: {len(seconds)} frames of {key} span {between:.0f} video frames, "
                    f"expected less than {2 * VIDEO_FRAMES}"
                )
            images = decode_video_frames(file, seconds, VIDEO_TOLERANCE, "pyav", return_uint8=True, is_depth=is_depth)
            if is_depth:
                coding = DepthEncoderConfig.from_video_info(info)
                images = dequantize_depth(
                    images, coding.depth_min, coding.depth_max, coding.shift, coding.use_log, output_unit="m"
                )
                depths = images[:, 0].numpy().astype(np.float32)
                # The codes start at depth_min: an invalid 0 was clipped to it.
                yield from np.where(depths > np.float32(coding.depth_min) * ABOVE_MINIMUM, depths, np.float32(0))
            else:
                yield from images.permute(0, 2, 3, 1).contiguous().numpy()


class EpisodeTables:
    """Reader of single episodes from a table file with row groups of any size.

    Args:
        dataset: the dataset.
        file: one of its table files.
        columns: columns to read; by default all.

    Raises:
        DatasetError: if the rows are larger than their images can require.
    """

    def __init__(self, dataset: SourceDataset, file: Path, columns: list[str] | None = None):
        self._dataset = dataset
        self._columns = columns
        self._file = pq.ParquetFile(file)
        metadata = self._file.metadata
        groups = [metadata.row_group(group) for group in range(metadata.num_row_groups)]
        images = [feature["shape"] for feature in dataset.features.values() if feature["dtype"] == "image"]
        row_bytes = ROW_BYTES + sum(8 * pixels(shape) for shape in images)
        largest = max((group.total_byte_size / max(group.num_rows, 1) for group in groups), default=0)
        if largest > row_bytes:
            raise DatasetError(f"{file} has rows of {largest:.0f} bytes, more than the {row_bytes} its images need")
        counts = [group.num_rows for group in groups]
        self._starts = np.cumsum([0, *counts])

    def read(self, episode: int) -> pa.Table:
        """Return the rows of an episode.

        Raises:
            DatasetError: if the file lacks them.
        """
        first = self._dataset.first_row(episode)
        count = self._dataset.episodes[episode]["length"]
        if not 0 <= first <= self._starts[-1] - count:
            raise DatasetError(
                f"episode {episode} has rows {first} to {first + count} by length and dataset_from_index, "
                f"its table has {self._starts[-1]}"
            )
        begin = int(np.searchsorted(self._starts, first, side="right")) - 1
        end = int(np.searchsorted(self._starts, first + count, side="left"))
        table = self._file.read_row_groups(list(range(begin, end)), columns=self._columns, use_threads=False)
        return table.slice(first - int(self._starts[begin]), count)


def vectors(table: pa.Table, column: str) -> NDArray:
    """Return a column of lists of equal length as an array (rows, length)."""
    return table[column].combine_chunks().flatten().to_numpy(zero_copy_only=False).reshape(len(table), -1)
