"""A recording in progress: its finished episodes, their shards, and the dataset aggregated from the shards.

    <target>.partial/request.json       description of the recording; a resumed run must have the same
    <target>.partial/episodes/*.npz     one episode per file, complete or absent
    <target>.partial/shards/*           LeRobot datasets of consecutive episodes, complete or absent
    <target>.partial/dataset            the aggregated shards, moved to <target> at the end

No file depends on which worker simulated an episode, or when: any number of workers writes the same data. A process
that is killed loses only the episodes that it was simulating.
"""

from __future__ import annotations

import io
import json
import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_symview.datasets.features import Features
from lerobot_symview.datasets.metadata import EPISODE_STYLE, RECORDING
from lerobot_symview.geometry.placement import described
from lerobot_symview.runtime.staging import DATASET, disk_errors, part_of, plain
from symview_sim.demonstration import EpisodeFrames, demonstrate
from symview_sim.settings import WorldSettings

SHARD_EPISODES, MAX_SHARDS = 25, 32
ATTEMPTS_KEY, STYLE_KEY = "attempts", "style"
ROBOT_TYPE = "symview"  # of every arm: states and actions are the gripper's, so recordings of different arms merge
# With its default block size and B-frames, x265 changed pixels of 85 of 1,080 noisy depth images despite `lossless`.
LOSSLESS = "lossless=1:ctu=16:bframes=0"
MAX_VIDEO_DEPTH = 1.6  # metres: with 12 bits, steps of 0.39 mm and errors of at most 0.2 mm


@dataclass(frozen=True)
class Recording:
    """Description and location of a recording, small enough to send to every worker."""

    folder: Path
    """`<target>.partial`."""
    repo_id: str
    env: WorldSettings
    instruction: str
    fps: int
    features: Features
    seed: int
    noise: float
    num_episodes: int
    video: bool

    def episode_file(self, episode: int) -> Path:
        """Return the file of an episode."""
        return self.folder / "episodes" / f"{episode:06d}.npz"

    def shards(self) -> list[range]:
        """Return the episodes of each shard: 25, or more to keep the number of shards at or below 32."""
        size = max(SHARD_EPISODES, -(-self.num_episodes // MAX_SHARDS))
        return [range(first, min(first + size, self.num_episodes)) for first in range(0, self.num_episodes, size)]

    def shard_folder(self, shard: range) -> Path:
        """Return the folder of a shard."""
        return self.folder / "shards" / f"{shard.start:06d}"

    def description(self) -> dict[str, Any]:
        """Return everything that determines the data, as JSON values."""
        content = asdict(self)
        del content["folder"]
        content["env"]["camera"] = described(self.env.camera)
        content["env"]["more_cameras"] = [described(spec) for spec in self.env.more_cameras]
        versions = {"symview": version("lerobot_policy_symview")}
        versions |= {package: version(package) for package in self.env.packages}
        return plain(content | versions)


def record_episode(recording: Recording, episode: int) -> int:
    """Simulate an episode, write its file and return the number of attempts."""
    frames, attempts, style = demonstrate(recording.env, recording.seed, episode, recording.noise)
    file = recording.episode_file(episode)
    part = part_of(file)
    content: dict[str, Any] = {**frames, ATTEMPTS_KEY: attempts, STYLE_KEY: json.dumps(style)}
    try:
        with disk_errors(recording.folder):
            file.parent.mkdir(exist_ok=True)
            with part.open("wb") as stream:
                np.savez(stream, **content)
            part.replace(file)
    finally:
        part.unlink(missing_ok=True)
    return attempts


def recorded_attempts(recording: Recording) -> dict[int, int]:
    """Return the number of attempts of each episode recorded so far, by episode index."""
    attempts = {}
    for file in sorted((recording.folder / "episodes").glob("*.npz")):
        with np.load(file) as content:
            attempts[int(file.stem)] = int(content[ATTEMPTS_KEY])
    return attempts


def write_shard(recording: Recording, shard: range) -> Path:
    """Write the LeRobot dataset of a shard's episodes, unless it exists, and return its folder."""
    folder = recording.shard_folder(shard)
    if folder.exists():
        return folder
    part = part_of(folder)
    with disk_errors(recording.folder), _failed_images() as failures, _unhashed():
        dataset = _create_dataset(recording, part)
        for episode in shard:
            for frame in _frames(recording.episode_file(episode)):
                dataset.add_frame(frame | {"task": recording.instruction})
                if failures:
                    raise OSError(failures[0])
            dataset.save_episode(parallel_encoding=False)
        dataset.finalize()
        _add_styles(recording, shard, part)
        shutil.rmtree(part / "images")  # LeRobot does not remove its empty temporary folders
        if not folder.exists():  # a cluster repeats the work of a worker that it has lost
            part.rename(folder)
    return folder


def _add_styles(recording: Recording, shard: range, folder: Path) -> None:
    """Add the style of each episode to a shard's table of episodes, unless the episodes have none."""
    styles = [_style(recording.episode_file(episode)) for episode in shard]
    for file in sorted((folder / "meta" / "episodes").rglob("*.parquet")) if any(styles) else ():
        table = pq.read_table(file)
        column = [json.dumps(styles[index]) for index in table["episode_index"].to_pylist()]
        pq.write_table(table.append_column(EPISODE_STYLE, pa.array(column)), file)


def join_shards(recording: Recording, shards: list[Path]) -> None:
    """Aggregate the shards into one dataset and complete its metadata."""
    from lerobot.datasets import aggregate_datasets

    joined = recording.folder / DATASET
    if joined.exists():
        shutil.rmtree(joined)
    attempts = recorded_attempts(recording)
    with disk_errors(recording.folder):
        if len(shards) == 1:
            shards[0].rename(joined)
        else:
            with redirect_stderr(io.StringIO()):  # its progress bars
                aggregate_datasets(
                    [recording.repo_id] * len(shards),
                    recording.repo_id,
                    roots=shards,
                    aggr_root=joined,
                    concatenate_data=False,
                    concatenate_videos=False,
                )
        stats = joined / "meta" / "stats.json"
        stats.write_text(json.dumps(json.loads(stats.read_text()), indent=4, sort_keys=True))  # the order varies
        content = recording.description() | {"expert_success_rate": len(attempts) / sum(attempts.values())}
        (joined / "meta" / RECORDING).write_text(json.dumps(content, indent=4))


def _create_dataset(recording: Recording, root: Path) -> Any:
    import av
    from lerobot.configs.video import DepthEncoderConfig, RGBEncoderConfig
    from lerobot.datasets import LeRobotDataset

    av.logging.set_libav_level(av.logging.ERROR)  # FFmpeg logs every pass over a file
    lossless = {"x265-params": f"{LOSSLESS}:log-level=none"}
    encoders = {
        "rgb_encoder": RGBEncoderConfig(vcodec="hevc", pix_fmt="gbrp", crf=None, extra_options=lossless),
        "depth_encoder": DepthEncoderConfig(
            vcodec="hevc",
            pix_fmt="gray12le",
            extra_options=lossless,
            depth_min=0.0,  # stores 0, which marks invalid depth, exactly
            depth_max=MAX_VIDEO_DEPTH,
            use_log=False,
        ),
    }
    return LeRobotDataset.create(
        recording.repo_id,
        fps=recording.fps,
        features={key: dict(feature) for key, feature in recording.features.items()},
        root=root,
        robot_type=ROBOT_TYPE,
        use_videos=recording.video,
        **(encoders if recording.video else {}),
    )


def _style(file: Path) -> dict[str, Any]:
    with np.load(file) as content:
        return json.loads(str(content[STYLE_KEY]))


def _frames(file: Path) -> Iterator[EpisodeFrames]:
    with np.load(file) as content:
        episode = {key: content[key] for key in content.files if key not in (ATTEMPTS_KEY, STYLE_KEY)}
    for index in range(len(next(iter(episode.values())))):
        yield {key: values[index] for key, values in episode.items()}


@contextmanager
def _failed_images() -> Iterator[list[str]]:
    """Yield a list that collects the errors of LeRobot's image writer, which logs them and continues."""
    failures: list[str] = []
    handler = logging.Handler(logging.ERROR)
    handler.emit = lambda record: failures.append(record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger("lerobot.datasets.image_writer")
    logger.addHandler(handler)
    try:
        yield failures
    finally:
        logger.removeHandler(handler)


@contextmanager
def _unhashed() -> Iterator[None]:
    """Skip the hash of each episode's table, a sixth of the time. It names a cache that LeRobot never uses."""
    with patch("datasets.arrow_dataset.generate_fingerprint", return_value="0" * 16):
        yield
