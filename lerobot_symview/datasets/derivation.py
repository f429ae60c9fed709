"""Derived datasets: the episodes of a source with new columns, written in parts by any number of processes.

    <target>.partial/request.json       settings of the result; a resumed run must have the same
    <target>.partial/dataset/           the result; each table file is one part, complete or absent
    <target>.partial/statistics/        statistics of the new images, one file per part

A part is a range of consecutive episodes. The parts depend on the source alone, so the result is the same for any
number of processes and any order of parts.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from tqdm import tqdm

from lerobot_symview.datasets.features import Features
from lerobot_symview.datasets.image_statistics import ImageStatistics, image_summary
from lerobot_symview.datasets.source import EpisodeTables, SourceDataset
from lerobot_symview.runtime.staging import DATASET, disk_errors, new_result, part_of

PART_FRAMES = 200  # least frames of a part, unless its source file has fewer

Derive = Callable[[int, pa.Table], tuple[dict[str, pa.Array], dict[str, ImageStatistics]]]
"""Takes an episode and its table; returns its new columns, and the statistics of its new images."""


@dataclass(frozen=True, kw_only=True)
class Derivation(ABC):
    """Source, settings and schema of a derived dataset; small enough to send to every worker."""

    source: Path
    """Folder of the source dataset."""
    source_files: str
    """`source_fingerprint` of the source when the run started."""
    folder: Path
    """`<target>.partial`."""
    dropped: list[str]
    """Keys of the source features that are not copied."""
    added: Features
    """Declarations of the new features; one of the source's name takes its place."""
    declared: Features = field(default_factory=dict)
    """Declarations of copied features that change."""
    schema: pa.Schema = field(repr=False)
    """Schema of the result's tables."""

    @property
    @abstractmethod
    def columns(self) -> list[str]:
        """Columns of the source from which the new ones are made."""

    @abstractmethod
    def deriver(self) -> Derive:
        """Return what makes the new columns of the episodes of a part."""

    @property
    def image_kinds(self) -> dict[str, Literal["rgb", "height"]]:
        """`rgb` or `height` for every new image feature."""
        return {}

    @abstractmethod
    def vector_summaries(self, episodes: list[pa.Table]) -> dict[str, list[dict[str, Any]]]:
        """Return LeRobot's statistics of every other new feature: over the dataset, then over each episode.

        Args:
            episodes: the new vectors of every episode of the result.
        """

    @property
    def dataset(self) -> Path:
        """Folder of the unfinished result."""
        return self.folder / DATASET

    def open_source(self) -> SourceDataset:
        """Return the source dataset; its metadata is cached per process."""
        return _opened(self.source, self.source_files)

    def no_statistics(self) -> dict[str, ImageStatistics]:
        """Return empty statistics for every new image feature."""
        return {key: ImageStatistics.empty(kind) for key, kind in self.image_kinds.items()}

    def table_file(self, source: SourceDataset, part: int) -> Path:
        """Return the file of a part's table in the result."""
        return self.dataset / source.data_path(*self.file_index(source, part))

    def file_index(self, source: SourceDataset, part: int) -> tuple[int, int]:
        """Return the chunk index and file index of a part's table."""
        return divmod(part, source.info["chunks_size"])

    def statistics_file(self, part: int) -> Path:
        """Return the file with the statistics of a part's new images."""
        return self.folder / "statistics" / f"{part:06d}.npz"


@lru_cache(maxsize=1)
def _opened(folder: Path, _fingerprint: str) -> SourceDataset:
    return SourceDataset(folder)


def cut_parts(source: SourceDataset) -> list[range]:
    """Return the episodes of every part: consecutive, of one file, and 200 frames or more if the file has them."""
    parts: list[range] = []
    frames = 0
    for episode, row in enumerate(source.episodes):
        if parts and frames < PART_FRAMES and source.file_index(episode) == source.file_index(parts[-1].start):
            parts[-1] = range(parts[-1].start, episode + 1)
            frames += row["length"]
        else:
            parts.append(range(episode, episode + 1))
            frames = row["length"]
    return parts


def derived_schema(source: SourceDataset, dropped: list[str], added: Features) -> pa.Schema:
    """Return the schema of the result's tables, with the metadata that Hugging Face's `datasets` reads."""
    from datasets import Features as TableFeatures
    from datasets import Image, List, Value

    features = dict(TableFeatures.from_arrow_schema(pq.read_schema(source.data_file(0))))
    for key in dropped:
        features.pop(key, None)  # videos have no column
    for key, feature in added.items():
        is_image = feature["dtype"] == "image"
        features[key] = Image() if is_image else List(Value(feature["dtype"]), length=feature["shape"][0])
    return TableFeatures(features).arrow_schema


def write_dataset(
    derivation: Derivation,
    executor: Any,
    target: Path,
    label: str,
    description: dict[str, Any],
    settings: str,
    resume: bool,
) -> None:
    """Write a derived dataset with a progress bar.

    Args:
        derivation: what to write.
        executor: runs the parts, see `runtime.executors`.
        target: folder of the result.
        label: of the progress bar.
        description: all settings that determine the result; they go into its file `settings`.
        settings: name of that file.
        resume: whether to continue an interrupted run.

    Raises:
        CommandError: if the result is there, or an interrupted run that is not to be resumed or had other settings.
    """
    source = derivation.open_source()
    parts = cut_parts(source)
    with new_result(target, description, resume, "--new_root"):
        with executor, tqdm(desc=label, total=source.info["total_frames"], unit="frame") as bar:
            for count in executor.run(partial(write_part, derivation), list(enumerate(parts))):
                bar.update(count)
        finish(derivation, parts, description, settings)


def write_part(derivation: Derivation, part: tuple[int, range]) -> int:
    """Write the table and statistics of a part unless they exist; return its number of frames."""
    index, episodes = part
    source = derivation.open_source()
    count = sum(source.episodes[episode]["length"] for episode in episodes)
    table_file, statistics_file = derivation.table_file(source, index), derivation.statistics_file(index)
    if table_file.exists():
        return count
    merged = derivation.no_statistics()
    summaries: dict[str, list[NDArray]] = {key: [] for key in merged}
    derive = derivation.deriver()
    kept = [name for name in derivation.schema.names if name not in derivation.added]
    columns = list(dict.fromkeys([*kept, *derivation.columns]))
    tables = EpisodeTables(source, source.data_file(episodes.start), columns)
    # Temporary files are outside the result, so that it contains none if a process is killed.
    table_part, statistics_part = (part_of(derivation.folder / file.name) for file in (table_file, statistics_file))
    with disk_errors(derivation.folder):
        try:
            with pq.ParquetWriter(table_part, derivation.schema) as writer:
                for episode in episodes:
                    table = tables.read(episode)
                    new, statistics = derive(episode, table)
                    arrays = [table[name] if name in kept else new[name] for name in derivation.schema.names]
                    # one row group per episode, as LeRobot writes them
                    writer.write_table(pa.table(arrays, schema=derivation.schema), row_group_size=len(table))
                    for key, episode_statistics in statistics.items():
                        summaries[key].append(episode_statistics.summary())
                        merged[key].merge(episode_statistics)
            with statistics_part.open("wb") as stream:
                np.savez_compressed(stream, **_packed(merged, summaries))
            for done, file in ((statistics_part, statistics_file), (table_part, table_file)):
                file.parent.mkdir(parents=True, exist_ok=True)
                done.replace(file)
        finally:
            for leftover in (table_part, statistics_part):
                leftover.unlink(missing_ok=True)
    return count


def _packed(merged: dict[str, ImageStatistics], summaries: dict[str, list[NDArray]]) -> dict[str, Any]:
    packed: dict[str, Any] = {}
    for key, total in merged.items():
        packed |= {f"{key}/images": total.images, f"{key}/counts": total.counts, f"{key}/sums": total.sums}
        packed[f"{key}/summaries"] = np.stack(summaries[key])
    return packed


def finish(derivation: Derivation, parts: list[range], description: dict[str, Any], settings: str) -> None:
    """Add videos and metadata to the result once all its tables are written; `description` to the file `settings`."""
    source = derivation.open_source()
    with disk_errors(derivation.folder):
        for key, feature in source.features.items():
            if feature["dtype"] == "video" and key not in derivation.dropped:
                shutil.copytree(source.folder / "videos" / key, derivation.dataset / "videos" / key, dirs_exist_ok=True)
        meta = derivation.dataset / "meta"
        if meta.exists():
            shutil.rmtree(meta)
        shutil.copytree(source.folder / "meta", meta)
        totals, of_episodes = _collect_statistics(derivation, source, parts)
        for file in sorted((meta / "episodes").rglob("*.parquet")):
            _rewrite_episodes(file, derivation, source, parts, of_episodes)
        info = dict(source.info)
        kept = {key: feature for key, feature in source.features.items() if key not in derivation.dropped}
        info["features"] = kept | derivation.declared | derivation.added
        if not any(feature["dtype"] == "video" for feature in kept.values()):
            info["video_path"] = None
        (meta / "info.json").write_text(json.dumps(info, indent=4))
        stats = json.loads((meta / "stats.json").read_text())
        stats = {key: value for key, value in stats.items() if key not in derivation.dropped} | totals
        (meta / "stats.json").write_text(json.dumps(stats, indent=4, sort_keys=True))
        (meta / settings).write_text(json.dumps(description, indent=4))


def _collect_statistics(
    derivation: Derivation, source: SourceDataset, parts: list[range]
) -> tuple[dict[str, Any], dict[str, dict[str, list[Any]]]]:
    """Return the statistics of every new feature over the dataset, and as lists with one entry per episode."""
    totals = derivation.no_statistics()
    summaries: dict[str, list[NDArray]] = {key: [] for key in totals}
    for part in range(len(parts)):
        with np.load(derivation.statistics_file(part)) as content:
            for key, total in totals.items():
                images, counts, sums = (content[f"{key}/{name}"] for name in ("images", "counts", "sums"))
                total.merge(ImageStatistics(total.kind, int(images), counts, sums))
                summaries[key].append(content[f"{key}/summaries"])
    lengths = [row["length"] for row in source.episodes]
    collected: dict[str, Any] = {key: image_summary(total.summary(), total.images) for key, total in totals.items()}
    of_episodes = {key: image_summary(np.concatenate(values), lengths) for key, values in summaries.items()}
    for key, (whole, *each) in derivation.vector_summaries(_new_vectors(derivation, source, parts)).items():
        collected[key] = whole
        of_episodes[key] = {name: [summary[name] for summary in each] for name in whole}
    return collected, of_episodes


def _new_vectors(derivation: Derivation, source: SourceDataset, parts: list[range]) -> list[pa.Table]:
    """Return the new columns of every episode of the result, without images."""
    names = [name for name in derivation.added if name not in derivation.image_kinds]
    tables = []
    for part, episodes in enumerate(parts):
        table = pq.read_table(derivation.table_file(source, part), columns=names)
        first = 0
        for episode in episodes:
            length = source.episodes[episode]["length"]
            tables.append(table.slice(first, length))
            first += length
    return tables


def _rewrite_episodes(
    file: Path,
    derivation: Derivation,
    source: SourceDataset,
    parts: list[range],
    statistics: dict[str, dict[str, list[Any]]],
) -> None:
    """Update the table locations of a file of episode metadata, and its statistics."""
    table = pq.read_table(file).replace_schema_metadata(None)
    dropped = tuple(
        f"{prefix}/{key}/" for prefix in ("stats", "videos") for key in (*derivation.dropped, *derivation.added)
    )
    table = table.drop_columns([name for name in table.column_names if name.startswith(dropped)])
    episodes = table["episode_index"].to_pylist()
    part_of_episode = {episode: part for part, range_ in enumerate(parts) for episode in range_}
    file_indices = np.array([derivation.file_index(source, part_of_episode[episode]) for episode in episodes])
    for column, values in (("data/chunk_index", file_indices[:, 0]), ("data/file_index", file_indices[:, 1])):
        table = table.set_column(table.column_names.index(column), column, pa.array(values))
    for key, named in statistics.items():
        for name, of_episodes in named.items():
            column = pa.array([of_episodes[episode] for episode in episodes])
            table = table.append_column(f"stats/{key}/{name}", column)
    pq.write_table(table, file)


def source_fingerprint(source: SourceDataset) -> str:
    """Return a hash of the source's `info.json` and of the names and sizes of all its files."""
    digest = hashlib.sha256((source.folder / "meta" / "info.json").read_bytes())
    for file in sorted(path for path in source.folder.rglob("*") if path.is_file()):
        digest.update(f"{file.relative_to(source.folder)} {file.stat().st_size}\n".encode())
    return digest.hexdigest()
