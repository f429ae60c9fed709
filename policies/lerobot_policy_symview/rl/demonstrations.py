"""Reads demonstrations for reinforcement learning from a LeRobot dataset."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader

from lerobot_symview import keys
from lerobot_symview.datasets.metadata import RECORDING, read_settings
from lerobot_symview.datasets.source import SourceDataset
from lerobot_symview.geometry.placement import PINHOLE
from lerobot_symview.runtime.cli import CommandError, DatasetLocation
from lerobot_symview.runtime.staging import plain
from symview_sim.settings import EnvSettings

BATCH = 32
REWARD, SUCCESS = "next.reward", "next.success"


def open_dataset(target: DatasetLocation) -> Any:
    """Return the `LeRobotDataset`, depth in metres.

    Raises:
        CommandError: if it is not there.
    """
    from lerobot.datasets import LeRobotDataset

    folder = target.folder()
    source = SourceDataset(folder)
    dataset = LeRobotDataset(target.repo_id, root=folder, depth_output_unit="m", video_backend="pyav")
    for key in (key for key, feature in source.features.items() if feature["dtype"] == "image"):
        if any(chunk.field("bytes").null_count for chunk in dataset.hf_dataset.data.column(key).chunks):
            raise CommandError(f"{key} of the dataset in {folder} names files, expected images in its tables")
    return dataset


def check_scene(dataset: Any, env: EnvSettings, camera: str, merged: Sequence[str] = ()) -> None:
    """Check that a dataset's workspace, task, robot, control and cameras are those to simulate.

    A dataset without `meta/symview_recording.json`, such as a merged one, may have several tasks, robots and cameras;
    they are not checked.

    Args:
        dataset: a `LeRobotDataset`.
        env: what is to be simulated.
        camera: the policy's.
        merged: further cameras that its view merges.

    Raises:
        ValueError: if not; the message lists the flags that differ.
    """
    simulated = {spec.name: spec for spec in env.all_cameras}
    if camera not in simulated:
        raise ValueError(f"--policy.camera={camera} is not simulated; --env.camera.name is {env.camera.name!r}")
    missing = [name for name in merged if name not in simulated]
    if missing:
        raise ValueError(f"the policy's view merges {', '.join(missing)}: give --env.more_cameras")
    info = dataset.meta.features.get(keys.rgb(camera), {}).get("info") or {}
    recorded = read_settings(Path(dataset.root), RECORDING).get("env", {})
    cameras = (
        {spec["name"]: plain(PINHOLE) | spec for spec in (recorded["camera"], *recorded["more_cameras"])}
        if recorded
        else {}
    )
    pairs: dict[str, tuple[Any, Any]] = {}
    for flag, ours, theirs in (
        ("--env", {"task": env.task, "robot": env.robot, "control": env.control}, recorded),
        ("--env.workspace", asdict(env.workspace), info.get("symview", {}).get("workspace", {})),
        ("--env.camera", asdict(simulated[camera]), cameras.get(camera, {})),
        *((f"--env.more_cameras: {name}", asdict(simulated[name]), cameras.get(name, {})) for name in merged),
    ):
        pairs |= {f"{flag}.{name}": (value, theirs[name]) for name, value in plain(ours).items() if name in theirs}
    differing = [
        f"{flag} is {ours!r}, the dataset has {theirs!r}" for flag, (ours, theirs) in pairs.items() if ours != theirs
    ]
    if differing:
        raise ValueError(f"the demonstrations were recorded in a different scene: {'; '.join(differing)}")


def observations(dataset: Any) -> Iterator[tuple[dict[str, Tensor], Tensor]]:
    """Yield batches of observations, in the format of an environment's, and of actions (B, A)."""
    for batch in DataLoader(dataset, batch_size=BATCH):
        yield {name: value for name, value in batch.items() if name.startswith("observation.")}, batch[keys.ACTION]


def rewards_and_ends(dataset: Any) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return, for every frame, its reward, whether its episode ends there, and whether it ends there with success.

    A dataset without `next.reward` gets a reward of 1 at the end of every episode; in one without `next.success`, every
    episode is a success.
    """
    table = dataset.hf_dataset.with_format("numpy")
    ends = np.append(np.diff(table["episode_index"][:]) != 0, True)
    recorded = {
        name: np.asarray(table[name][:]).reshape(-1) for name in (REWARD, SUCCESS) if name in table.column_names
    }
    reward = recorded.get(REWARD, ends).astype(np.float32)
    return reward, ends, ends & recorded.get(SUCCESS, ends).astype(bool)


def ranges(dataset: Any, action_limits: tuple[NDArray, NDArray]) -> dict[str, dict[str, Tensor]]:
    """Return the ranges for scaling: the dataset's of the states, the environment's limits of the actions."""
    states = dataset.meta.stats[keys.STATE]
    return {
        keys.STATE: {name: torch.as_tensor(states[name]) for name in ("min", "max")},
        keys.ACTION: {name: torch.as_tensor(limit) for name, limit in zip(("min", "max"), action_limits, strict=True)},
    }
