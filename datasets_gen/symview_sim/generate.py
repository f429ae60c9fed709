"""`symview-generate`: record expert demonstrations of a task as a LeRobot dataset."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import draccus
import numpy as np
from tqdm import tqdm

from lerobot_symview import keys
from lerobot_symview.datasets.action_targets import relative_action_feature
from lerobot_symview.datasets.features import Features, camera_features, color_feature
from lerobot_symview.datasets.hub import push_dataset
from lerobot_symview.datasets.metadata import RECORDING
from lerobot_symview.geometry.camera import project
from lerobot_symview.registry import lookup
from lerobot_symview.runtime.cli import run_command
from lerobot_symview.runtime.executors import EXECUTORS
from lerobot_symview.runtime.staging import is_complete, new_result, partial_folder
from symview_sim.recording import (
    MAX_VIDEO_DEPTH,
    Recording,
    join_shards,
    record_episode,
    recorded_attempts,
    write_shard,
)
from symview_sim.settings import WRIST_SIZE, EnvSettings, NewDataset, WorldSettings
from symview_sim.table_env import TableEnv
from symview_sim.worlds.fetch import FetchSettings
from symview_sim.worlds.metaworld import MetaWorldSettings

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-generate --dataset.repo_id=me/picking --env.task=block_picking --num_episodes=50
  symview-generate --env.task=drawer_opening --num_episodes=20 --num_workers=2 --root=data/drawer
  symview-generate --root=data/anywhere --env.camera.spread.azimuth_deg=180 --env.camera.spread.elevation_deg=20
  symview-generate --dataset.repo_id=me/picking --dataset.push_to_hub=true --dataset.private=true
  symview-generate --root=data/push --env.type=metaworld --env.task=push-v3 --num_episodes=25
  symview-generate --root=data/people --env.control=fine --env.style=human --num_episodes=100
  symview-generate --root=data/two --env.more_cameras='[{name: left, azimuth_deg: 90, height: 240, width: 320}]'"""


class RecordedWorld(draccus.ChoiceRegistry, WorldSettings):
    """The environment of a recording; `--env.type` selects its simulator."""

    @classmethod
    def default_choice_name(cls) -> str:
        """Return the simulator that is used without `--env.type`."""
        return "symview"


@RecordedWorld.register_subclass("symview")
@dataclass(unsafe_hash=True)
class RecordedEnv(EnvSettings, RecordedWorld):
    """The environment settings of a recording in PyBullet. The oracle is recorded by default."""

    oracle: bool = True
    """Add the camera `top`, which looks straight down and does not see the arm."""


@RecordedWorld.register_subclass("metaworld")
@dataclass(unsafe_hash=True)
class RecordedMetaWorld(MetaWorldSettings, RecordedWorld):
    """The environment settings of a recording in Meta-World."""


@RecordedWorld.register_subclass("fetch")
@dataclass(unsafe_hash=True)
class RecordedFetch(FetchSettings, RecordedWorld):
    """The environment settings of a recording of FetchPush."""


@dataclass(frozen=True)
class GenerateConfig:
    """Record demonstrations of a task by its scripted expert as a LeRobot dataset."""

    dataset: NewDataset = field(default_factory=NewDataset)
    """Location of the new dataset; `--root` is short for `--dataset.root`."""
    env: RecordedWorld = field(default_factory=RecordedEnv)
    """Simulator (`--env.type`: `symview`, `metaworld` or `fetch`), task, workspace and cameras."""
    num_episodes: int = 50
    """Number of successful demonstrations."""
    seed: int = 0
    """Random seed. Episode i starts from seed 10^9 (seed + 1) + 100 i, plus 1 for each failed attempt."""
    noise: float = 0.0
    """Standard deviation of the noise added to each action, as a fraction of the largest action (0.2: 1 cm and 9
    degrees). The dataset contains the expert's actions without noise and so shows how to recover from small errors.
    """
    video: bool = False
    """Store images as video: RGB lossless, depth up to 1.6 m with an error below 0.2 mm. The oracle's depth exceeds
    1.6 m and is stored as images. Video is smaller on disk and several times slower to train from."""
    num_workers: int = 1
    """Number of worker processes. It does not change the data. Ignored if RAY_ADDRESS names a cluster."""
    executor: str = "local"
    """`local`, or `ray`: the cluster of RAY_ADDRESS, whose machines must share the folders, or a local Ray."""
    resume: bool = False
    """Continue an interrupted recording."""

    def __post_init__(self) -> None:
        if self.num_episodes < 1:
            raise ValueError(f"--num_episodes must be at least 1, got {self.num_episodes}")
        if self.seed < 0:
            raise ValueError(f"--seed must not be negative, got {self.seed}")
        if not 0 <= self.noise <= 1:
            raise ValueError(f"--noise must lie in [0, 1], got {self.noise}")
        lookup("--executor", self.executor, EXECUTORS)
        if self.num_workers < 1:
            raise ValueError(f"--num_workers must be at least 1, got {self.num_workers}")


def generate(config: GenerateConfig) -> Path:
    """Record the dataset of `config`, push it to the Hub if requested, and return its folder."""
    folder = _write(config)
    if config.dataset.push_to_hub:
        push_dataset(config.dataset, config.dataset)
    return folder


def _write(config: GenerateConfig) -> Path:
    target = config.dataset.folder()
    recording = plan_recording(config, target)
    if is_complete(target, RECORDING, recording.description(), config.resume, "--dataset.root"):
        logger.info("%s is already complete", target)
        return target
    with new_result(target, recording.description(), config.resume, "--dataset.root"):
        attempts = recorded_attempts(recording)
        missing = [episode for episode in range(config.num_episodes) if episode not in attempts]
        with EXECUTORS[config.executor](config.num_workers, "symview_sim.recording") as executor:
            with tqdm(desc=config.env.task, total=config.num_episodes, initial=len(attempts), unit="episode") as bar:
                done, tried = len(attempts), sum(attempts.values())
                for taken in executor.run(partial(record_episode, recording), missing):
                    done, tried = done + 1, tried + taken
                    bar.set_postfix_str(f"expert succeeds {done / tried:.0%}", refresh=False)
                    bar.update()
            shards = recording.shards()
            written = executor.run(partial(write_shard, recording), shards)
            import lerobot.datasets  # noqa: F401  takes seconds, in parallel with the workers

            folders = list(tqdm(written, desc="writing", total=len(shards), unit="shard"))
        join_shards(recording, sorted(folders))
    logger.info("wrote %d demonstrations to %s; the expert succeeded in %.1f %%", done, target, 100 * done / tried)
    return target


def plan_recording(config: GenerateConfig, target: Path) -> Recording:
    """Return what is recorded and where; this makes the environment once.

    Raises:
        ValueError: if a camera sees farther than the depth of a video reaches.
    """
    env = config.env.make()
    if config.video:
        _check_video_depth(env)
    recording = Recording(
        folder=partial_folder(target),
        repo_id=config.dataset.repo_id,
        env=config.env,
        instruction=env.task_description,
        fps=config.env.actions_per_second,
        features=_features(env, config),
        seed=config.seed,
        noise=config.noise,
        num_episodes=config.num_episodes,
        video=config.video,
    )
    env.close()
    return recording


def _check_video_depth(env: TableEnv) -> None:
    """Raise a ValueError if a part of the workspace may be farther from a camera than the largest depth of a video."""
    half, height = env.workspace.size / 2, env.workspace.height_limit
    corners = np.concatenate([env.workspace.corners(), env.workspace.corners(height)])
    for spec in env.specs:
        if spec.name == keys.ORACLE:
            continue
        if spec.varies:  # an upper bound over all random poses
            farthest = spec.distance + spec.spread.distance + 2 * spec.spread.target
            farthest += float(np.linalg.norm(spec.target) + np.linalg.norm([half, half, height]))
        else:
            farthest = project(corners, env.cameras[spec.name])[1].max()
        if farthest > MAX_VIDEO_DEPTH:
            raise ValueError(
                f"camera {spec.name!r} is up to {farthest:.2f} m from a point of the workspace, but "
                f"--video=true stores depth up to {MAX_VIDEO_DEPTH} m: reduce its distance or use --video=false"
            )


def _features(env: TableEnv, config: GenerateConfig) -> Features:
    features: Features = {
        keys.STATE: _vector(config.env.state_names),
        keys.ACTION: relative_action_feature(config.env.action_names),
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
        "next.done": {"dtype": "bool", "shape": (1,), "names": None},
        "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    }
    for spec in env.specs:
        shown = {"depth": config.env.depth, "segmentation": config.env.has_labels, "lens": spec.states_lens}
        features |= camera_features(spec.name, spec.height, spec.width, env.workspace, **shown)
    if config.env.has_wrist_camera:
        features[keys.rgb(keys.WRIST)] = color_feature(WRIST_SIZE, WRIST_SIZE, {"fixed_to": "gripper"})
    if config.video:
        for key, feature in features.items():
            if feature["dtype"] == "image" and key != keys.depth(keys.ORACLE):
                feature["dtype"] = "video"
    return features


def _vector(names: Sequence[str]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (len(names),), "names": list(names)}


def main() -> None:
    """Run `symview-generate`."""
    run_command(GenerateConfig, generate, EXAMPLES, short={"--root": "--dataset.root"})
