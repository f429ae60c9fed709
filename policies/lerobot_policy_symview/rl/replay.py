"""Prioritised experience replay in compact types, each frame stored once.

Transitions are stored where they happen, in `streams`: the demonstrations are one, each simulator is another. A stream
is a ring of slots. A slot has a frame and, if an action was taken there, what came of it; the frame that the action led
to is the next slot's. When a ring is full, its oldest slot is overwritten; the demonstrations' is never full.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_policy_symview.inputs.observation_codec import StoredObservation


@dataclass(frozen=True)
class ReplayConfig:
    """What is remembered, and what is sampled from it (Schaul et al., 2015)."""

    capacity: int = 100_000
    """Transitions of the simulators to keep; no more are provided for than the training makes."""
    alpha: float = 0.6
    """Power of the priority that the chance of being sampled is proportional to."""
    beta: float = 0.4
    """Power of the correction for unequal chances at the start; it grows to 1 in the end."""
    epsilon: float = 1e-6
    """Added to every priority."""
    expert_bonus: float = 1.0
    """Added to the priority of what the expert did."""
    memory_limit_gb: float = 8.0
    """Frames that need more are kept in files in the output folder, memory-mapped."""

    def __post_init__(self) -> None:
        for name in ("alpha", "beta"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"--replay.{name} must lie in [0, 1], got {getattr(self, name)}")
        if self.epsilon <= 0:
            raise ValueError(f"--replay.epsilon must be positive, got {self.epsilon}")
        if self.expert_bonus < 0:
            raise ValueError(f"--replay.expert_bonus must not be negative, got {self.expert_bonus}")
        if self.capacity < 1:
            raise ValueError(f"--replay.capacity must be at least 1, got {self.capacity}")


@dataclass(frozen=True)
class Sample:
    """Transitions drawn from a replay; B of them.

    Args:
        slots: (B,) where they are.
        frames: feature -> (2 B, ...), what was seen before and, in the second half, after the action, as stored.
        action: (B, A) scaled.
        reward: (B,).
        terminal: (B,) bool, whether nothing follows; the frame after it is then the one before.
        expert: (B,) bool.
        weight: (B,) in (0, 1], the correction for unequal chances.
    """

    slots: NDArray[np.int64]
    frames: dict[str, Tensor]
    action: Tensor
    reward: Tensor
    terminal: Tensor
    expert: Tensor
    weight: Tensor


class Replay:
    """Streams of transitions, sampled in proportion to a power of their priority.

    Args:
        config: what is remembered.
        example: a frame, whose shapes and types all frames have.
        actions: entries of an action.
        lengths: slots of every stream; the first is the expert's.
        folder: where frames are kept if they need more memory than allowed.
    """

    def __init__(
        self, config: ReplayConfig, example: StoredObservation, actions: int, lengths: Sequence[int], folder: Path
    ):
        self.config = config
        self._first = np.concatenate([[0], np.cumsum(lengths)])
        self.slots = slots = int(self._first[-1])
        self._columns: dict[str, NDArray[Any]] = {
            "action": np.zeros((slots, actions), np.float32),
            "reward": np.zeros(slots, np.float32),
            "terminal": np.zeros(slots, bool),
            "chance": np.zeros(slots),  # the power of the priority; 0 where no action was taken
        }
        frame_bytes = sum(array.nbytes for array in example.values())
        on_disk = slots * frame_bytes > config.memory_limit_gb * 1e9
        self._frames = {
            name: _allocate((slots, *array.shape), array.dtype, folder / f"{name}.npy" if on_disk else None)
            for name, array in example.items()
        }
        self._head: NDArray[np.int64] = np.full(len(lengths), -1)  # within the stream
        self._written: NDArray[np.int64] = np.zeros(len(lengths), np.int64)  # slots, per stream
        self._highest = 1.0  # priority so far, which new transitions get

    def __len__(self) -> int:
        """Transitions that can be sampled."""
        return int(np.count_nonzero(self._columns["chance"]))

    @property
    def bytes_per_transition(self) -> int:
        """Memory of a slot."""
        return sum(array[0].nbytes for array in (self._columns | self._frames).values())

    @property
    def is_on_disk(self) -> bool:
        """Whether frames are kept in files."""
        return any(isinstance(array, np.memmap) for array in self._frames.values())

    def begin(self, stream: int, frame: StoredObservation) -> None:
        """Write what an episode begins with."""
        self._advance(stream, frame)

    def add(
        self,
        stream: int,
        action: NDArray[np.float32],
        reward: float,
        terminal: bool,
        following: StoredObservation | None,
    ) -> None:
        """Complete the stream's newest slot.

        Args:
            stream: which.
            action: (A,) scaled.
            reward: for it.
            terminal: whether nothing follows.
            following: the frame that follows; None if `terminal`.
        """
        if terminal != (following is None):
            raise ValueError("a transition is followed by a frame unless it is terminal")
        slot = self._slot(stream)
        self._columns["action"][slot] = action
        self._columns["reward"][slot] = reward
        self._columns["terminal"][slot] = terminal
        self._columns["chance"][slot] = self._highest**self.config.alpha
        if following is not None:
            self._advance(stream, following)

    def sample(self, count: int, beta: float, rng: np.random.Generator) -> Sample:
        """Draw transitions, one from each of `count` equal parts of the sum of all chances.

        Args:
            count: B.
            beta: power of the correction.
            rng: draws them.
        """
        chance = self._columns["chance"]
        sums = chance.cumsum()
        drawn = (np.arange(count) + rng.random(count)) / count * sums[-1]
        slots = np.minimum(sums.searchsorted(drawn, side="right"), np.flatnonzero(chance)[-1])
        terminal = self._columns["terminal"][slots]
        weight = (chance[slots] / sums[-1] * len(self)) ** -beta
        gathered = torch.from_numpy(np.concatenate([slots, np.where(terminal, slots, self._after(slots))]))
        return Sample(
            slots=slots,
            frames={name: torch.from_numpy(array).index_select(0, gathered) for name, array in self._frames.items()},
            action=torch.from_numpy(self._columns["action"][slots]),
            reward=torch.from_numpy(self._columns["reward"][slots]),
            terminal=torch.from_numpy(terminal),
            expert=torch.from_numpy(self._is_expert(slots)),
            weight=torch.from_numpy((weight / weight.max()).astype(np.float32)),
        )

    def prioritise(self, slots: NDArray[np.int64], errors: NDArray[np.floating]) -> None:
        """Set priorities from the errors (B,) of estimated values, before anything is added to what was drawn from."""
        priority = errors + self.config.expert_bonus * self._is_expert(slots) + self.config.epsilon
        self._columns["chance"][slots] = priority**self.config.alpha
        self._highest = max(self._highest, float(priority.max()))

    def save(self, folder: Path) -> None:
        """Write everything that was ever written to a new folder."""
        folder.mkdir()
        used = [slice(first, first + count) for first, count in zip(self._first, self._written, strict=False)]
        for name, array in (self._columns | self._frames).items():
            shape = (int(self._written.sum()), *array.shape[1:])
            file = _mapped(folder / f"{name}.npy", shape, array.dtype)
            begin = 0
            for part in used:
                end = begin + part.stop - part.start
                file[begin:end] = array[part]
                begin = end
            file.flush()
        state = {"head": self._head.tolist(), "written": self._written.tolist(), "highest": self._highest}
        (folder / "state.json").write_text(json.dumps(state))

    def load(self, folder: Path) -> None:
        """Take over what `save` wrote for streams of the same lengths."""
        state = json.loads((folder / "state.json").read_text())
        self._head, self._written = np.array(state["head"]), np.array(state["written"])
        self._highest = state["highest"]
        for name, array in (self._columns | self._frames).items():
            saved = np.load(folder / f"{name}.npy", mmap_mode="r")
            begin = 0
            for first, count in zip(self._first, self._written, strict=False):
                array[first : first + count] = saved[begin : begin + count]
                begin += count

    def _advance(self, stream: int, frame: StoredObservation) -> None:
        length = int(self._first[stream + 1] - self._first[stream])
        self._head[stream] = (self._head[stream] + 1) % length
        self._written[stream] = max(self._written[stream], self._head[stream] + 1)
        slot = self._slot(stream)
        self._columns["chance"][slot] = 0.0
        for name, array in self._frames.items():
            array[slot] = frame[name]

    def _slot(self, stream: int) -> int:
        return int(self._first[stream] + self._head[stream])

    def _after(self, slots: NDArray[np.int64]) -> NDArray[np.int64]:
        stream = self._first.searchsorted(slots, side="right") - 1
        return np.where(slots + 1 == self._first[stream + 1], self._first[stream], slots + 1)

    def _is_expert(self, slots: NDArray[np.int64]) -> NDArray[np.bool_]:
        return slots < self._first[1]


def _allocate(shape: tuple[int, ...], dtype: np.dtype, file: Path | None) -> NDArray[Any]:
    if file is None:
        return np.zeros(shape, dtype)  # memory that is not written to is not taken
    file.parent.mkdir(parents=True, exist_ok=True)
    return _mapped(file, shape, dtype)


def _mapped(file: Path, shape: tuple[int, ...], dtype: np.dtype) -> np.memmap:
    return np.lib.format.open_memmap(file, "w+", dtype, shape)  # type: ignore[no-untyped-call]
