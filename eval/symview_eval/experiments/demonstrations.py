"""Demonstrations in memory, and the samples of training: histories of observations, and chunks of actions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_policy_symview.inputs.observation_codec import ObservationCodec
from lerobot_policy_symview.rl.demonstrations import observations
from lerobot_policy_symview.rl.rollouts import Actor
from lerobot_symview import keys

AUGMENTED_VARIANTS = 16  # of every frame, with camera augmentation; LeRobot's training makes a new one each time


class Demonstrations:
    """What a policy sees of a dataset, and its actions, on the policy's device.

    Samples have the policy's history of observations and chunk of actions, as those of a `LeRobotDataset` have: at the
    ends of an episode its first observation and its last action are repeated.

    Args:
        dataset: a `LeRobotDataset` with the camera's images.
        actor: the policy; what it sees of a frame is made once, or with camera augmentation as often as there are
            variants, which are independent in every frame of a history.
    """

    def __init__(self, dataset: Any, actor: Actor):
        config, self._finish = actor.policy.config, actor.finish
        self._device = torch.device(config.device)
        self._codec = ObservationCodec(actor.scene)
        frames, actions = [], []
        variants = AUGMENTED_VARIANTS if actor.scene.config.camera_augmentation else 1
        for _ in range(variants):
            for observation, action in observations(dataset):
                # with actions, as in training: the preprocessor augments observations that have some
                frames += self._codec.pack(actor.see(observation | {keys.ACTION: action}))
                actions.append(action)
        self._frames = {
            name: torch.stack([torch.from_numpy(frame[name]) for frame in frames]).to(self._device)
            for name in frames[0]
        }
        self._actions = torch.cat(actions).to(self._device)
        first, last = _bounds(dataset, variants)
        self._history = _neighbours(config.observation_delta_indices, first, last)
        self._chunks = _neighbours(config.action_delta_indices, first, last)
        self._starts = _starts(last, getattr(config, "drop_n_last_frames", 0))

    def batches(self, size: int, seed: int, start: int = 0) -> Iterator[dict[str, Tensor]]:
        """Yield batches of `size` samples without end; each pass visits every sample once in random order.

        The first `start` batches are left out, as when a training continues after as many steps.
        """
        for chosen in islice(self._order(size, seed), start, None):
            yield self.samples(chosen)

    def _order(self, size: int, seed: int) -> Iterator[Tensor]:
        """Yield the frames (size,) at which the samples of every batch start."""
        generator = torch.Generator().manual_seed(seed)
        order = torch.empty(0, dtype=torch.long)
        while True:
            while len(order) < size:
                order = torch.cat([order, self._starts[torch.randperm(len(self._starts), generator=generator)]])
            chosen, order = order[:size], order[size:]
            yield chosen

    def samples(self, chosen: Tensor) -> dict[str, Tensor]:
        """Return the samples of frames (B,) as a batch for the policy's training."""
        seen = chosen if self._history is None else self._history[0][chosen]
        at = seen.to(self._device)
        batch = self._codec.unpack({name: values[at] for name, values in self._frames.items()}, self._device)
        if self._chunks is None:
            batch[keys.ACTION] = self._actions[chosen.to(self._device)]
        else:
            planned, is_pad = (values[chosen].to(self._device) for values in self._chunks)
            batch |= {keys.ACTION: self._actions[planned], f"{keys.ACTION}_is_pad": is_pad}
        return self._finish(batch)


def _bounds(dataset: Any, variants: int) -> tuple[Tensor, Tensor]:
    """Return, for every frame (N,) of all variants, the first and the last frame of its episode."""
    episodes = torch.from_numpy(np.asarray(dataset.hf_dataset.with_format("numpy")["episode_index"][:]))
    lengths = torch.unique_consecutive(episodes, return_counts=True)[1].repeat(variants)
    ends = lengths.cumsum(0)
    return (ends - lengths).repeat_interleave(lengths), (ends - 1).repeat_interleave(lengths)


def _neighbours(offsets: Sequence[int] | None, first: Tensor, last: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return the frames (N, K) at `offsets` from each frame, within its episode, and whether they lie outside."""
    if offsets is None:
        return None
    frames = torch.arange(len(first))[:, None] + torch.tensor(offsets)
    within = frames.clamp(first[:, None], last[:, None])
    return within, within != frames


def _starts(last: Tensor, dropped: int) -> Tensor:
    """Return the frames that samples start at: all but the `dropped` last ones of every episode."""
    frames = torch.arange(len(last))
    return frames[frames <= last - dropped]
