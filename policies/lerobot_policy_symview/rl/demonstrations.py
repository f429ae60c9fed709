"""Demonstrations of a LeRobot dataset as transitions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader

from lerobot_symview import keys
from lerobot_symview.cli import CommandError, DatasetTarget

BATCH = 32
REWARD, SUCCESS = "next.reward", "next.success"


def open_dataset(target: DatasetTarget) -> Any:
    """Return the `LeRobotDataset`, depth in metres.

    Raises:
        CommandError: if it is not there.
    """
    from lerobot.datasets import LeRobotDataset

    folder = target.folder()
    if not (folder / "meta" / "info.json").is_file():
        raise CommandError(f"there is no dataset in {folder}: use --dataset.root, or symview-generate to make one")
    return LeRobotDataset(target.repo_id, root=folder, depth_output_unit="m", video_backend="pyav")


def observations(dataset: Any) -> Iterator[tuple[dict[str, Tensor], Tensor]]:
    """Yield batches of what was observed, as an environment would deliver it, and the actions (B, A)."""
    for batch in DataLoader(dataset, batch_size=BATCH):
        yield {name: value for name, value in batch.items() if name.startswith("observation.")}, batch[keys.ACTION]


def outcomes(dataset: Any) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return for every frame its reward, whether its episode ends there, and whether that is by success.

    A dataset that does not say is taken for one of successes, with a reward of 1 at the end of every episode.
    """
    table = dataset.hf_dataset.with_format("numpy")
    ends = np.append(np.diff(table["episode_index"][:]) != 0, True)
    stated = {name: np.asarray(table[name][:]).reshape(-1) for name in (REWARD, SUCCESS) if name in table.column_names}
    reward = stated.get(REWARD, ends).astype(np.float32)
    return reward, ends, ends & stated.get(SUCCESS, ends).astype(bool)


def ranges(dataset: Any, action_limits: tuple[NDArray, NDArray]) -> dict[str, dict[str, Tensor]]:
    """Return the ranges that scale states, the dataset's, and actions, the environment's."""
    states = dataset.meta.stats[keys.STATE]
    return {
        keys.STATE: {name: torch.as_tensor(states[name]) for name in ("min", "max")},
        keys.ACTION: {name: torch.as_tensor(limit) for name, limit in zip(("min", "max"), action_limits, strict=True)},
    }
