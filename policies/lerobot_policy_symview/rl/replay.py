"""Prioritised experience replay (Schaul et al., 2015) in compact types, each frame stored once.

Transitions are stored in the order they happen, in one `stream` per source: stream 0 has the demonstrations, each
simulator has one of its own. A stream is a ring buffer of slots. A slot holds a frame (a packed observation) and, if an
action was taken there, the action, reward and priority of the transition; the transition's next frame is that of the
next slot. A full ring overwrites its oldest slot; the demonstrations' stream is large enough never to be full.
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
    """Capacity and sampling of the prioritised replay buffer (Schaul et al., 2015)."""

    capacity: int = 100_000
    """Most transitions to keep of all simulators together; memory is reserved for no more than the run makes."""
    alpha: float = 0.6
    """Exponent of the priorities: transition i is sampled with probability proportional to p_i ** alpha."""
    beta: float = 0.4
    """Initial exponent of the importance-sampling weights; it grows linearly to 1 at the end of the run."""
    epsilon: float = 1e-6
    """Added to every priority, so that transitions without TD error are still sampled."""
    demo_priority_bonus: float = 1.0
    """Added to the priorities of demonstrated transitions."""
    memory_limit_gb: float = 8.0
    """Frames that need more memory than this are stored in memory-mapped files in the output folder."""

    def __post_init__(self) -> None:
        for name in ("alpha", "beta"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"--replay.{name} must lie in [0, 1], got {getattr(self, name)}")
        if self.epsilon <= 0:
            raise ValueError(f"--replay.epsilon must be positive, got {self.epsilon}")
        if self.demo_priority_bonus < 0:
            raise ValueError(f"--replay.demo_priority_bonus must not be negative, got {self.demo_priority_bonus}")
        if self.capacity < 1:
            raise ValueError(f"--replay.capacity must be at least 1, got {self.capacity}")


@dataclass(frozen=True)
class Sample:
    """A batch of B transitions.

    Args:
        slots: (B,) slots of the transitions, for `Replay.update_priorities`.
        frames: feature -> (2 B, ...), as stored: the observations, then the next observations.
        action: (B, A) scaled.
        reward: (B,).
        terminal: (B,) bool; the next observation of a terminal transition is its observation again.
        is_demo: (B,) bool, whether the transition is from the demonstrations.
        weight: (B,) in (0, 1], importance-sampling weights.
    """

    slots: NDArray[np.int64]
    frames: dict[str, Tensor]
    action: Tensor
    reward: Tensor
    terminal: Tensor
    is_demo: Tensor
    weight: Tensor


class Replay:
    """Prioritised replay buffer of several streams.

    Args:
        config: capacity and sampling.
        example: a frame, for the shapes and types of all frames.
        action_dim: A, dimensions of an action.
        lengths: slots of every stream; the first is the demonstrations'.
        folder: folder of the frames' files if they need more memory than allowed.

    Attributes:
        columns: `action` (slots, A), `reward`, `terminal` and `priority` (slots,); the priorities are p_i ** alpha, and
            0 where no transition begins.
        frames: feature -> (slots, ...).
    """

    def __init__(
        self, config: ReplayConfig, example: StoredObservation, action_dim: int, lengths: Sequence[int], folder: Path
    ):
        self.config = config
        self._first = np.concatenate([[0], np.cumsum(lengths)])
        self.slots = slots = int(self._first[-1])
        self.columns: dict[str, NDArray[Any]] = {
            "action": np.zeros((slots, action_dim), np.float32),
            "reward": np.zeros(slots, np.float32),
            "terminal": np.zeros(slots, bool),
            "priority": np.zeros(slots),
        }
        frame_bytes = sum(array.nbytes for array in example.values())
        on_disk = slots * frame_bytes > config.memory_limit_gb * 1e9
        self.frames = {
            name: _allocate((slots, *array.shape), array.dtype, folder / f"{name}.npy" if on_disk else None)
            for name, array in example.items()
        }
        self._head: NDArray[np.int64] = np.full(len(lengths), -1)  # newest slot, within each stream
        self._written: NDArray[np.int64] = np.zeros(len(lengths), np.int64)  # slots in use, of each stream
        self._max_priority = 1.0  # so far, before the exponent; new transitions get it

    def __len__(self) -> int:
        """Number of transitions that can be sampled."""
        return int(np.count_nonzero(self.columns["priority"]))

    @property
    def bytes_per_transition(self) -> int:
        """Memory of a slot."""
        return sum(array[0].nbytes for array in (self.columns | self.frames).values())

    @property
    def is_on_disk(self) -> bool:
        """Whether frames are stored in memory-mapped files."""
        return any(isinstance(array, np.memmap) for array in self.frames.values())

    def start_episode(self, stream: int, frame: StoredObservation) -> None:
        """Write the first frame of an episode to a stream."""
        self._advance(stream, frame)

    def add_transition(
        self,
        stream: int,
        action: NDArray[np.float32],
        reward: float,
        terminal: bool,
        next_frame: StoredObservation | None,
    ) -> None:
        """Add the transition that begins at the stream's newest frame.

        Args:
            stream: index of the stream.
            action: (A,) scaled.
            reward: of the action.
            terminal: whether the episode ends here without bootstrapping.
            next_frame: frame after the action; None if `terminal`.

        Raises:
            ValueError: if a terminal transition has a next frame, or another has none.
        """
        if terminal != (next_frame is None):
            raise ValueError("a transition needs a next frame unless it is terminal")
        slot = self._slot(stream)
        self.columns["action"][slot] = action
        self.columns["reward"][slot] = reward
        self.columns["terminal"][slot] = terminal
        self.columns["priority"][slot] = self._max_priority**self.config.alpha
        if next_frame is not None:
            self._advance(stream, next_frame)

    def sample(self, count: int, beta: float, rng: np.random.Generator) -> Sample:
        """Sample transitions in proportion to their priorities, one from each of `count` equal parts of their sum.

        Args:
            count: B.
            beta: exponent of the importance-sampling weights (1 / (N P(i))) ** beta, scaled to a maximum of 1.
            rng: random generator.
        """
        priority = self.columns["priority"]
        cumulative = priority.cumsum()
        drawn = (np.arange(count) + rng.random(count)) / count * cumulative[-1]
        slots = np.minimum(cumulative.searchsorted(drawn, side="right"), np.flatnonzero(priority)[-1])
        terminal = self.columns["terminal"][slots]
        probability = priority[slots] / cumulative[-1]
        weight = (probability * len(self)) ** -beta
        gathered = torch.from_numpy(np.concatenate([slots, np.where(terminal, slots, self._next(slots))]))
        return Sample(
            slots=slots,
            frames={name: torch.from_numpy(array).index_select(0, gathered) for name, array in self.frames.items()},
            action=torch.from_numpy(self.columns["action"][slots]),
            reward=torch.from_numpy(self.columns["reward"][slots]),
            terminal=torch.from_numpy(terminal),
            is_demo=torch.from_numpy(self._is_demo(slots)),
            weight=torch.from_numpy((weight / weight.max()).astype(np.float32)),
        )

    def update_priorities(self, slots: NDArray[np.int64], td_errors: NDArray[np.floating]) -> None:
        """Set the priorities of sampled transitions to their absolute TD errors (B,), epsilon and the demos' bonus.

        Call it before anything is added after the sampling, which may overwrite the slots.
        """
        priority = td_errors + self.config.demo_priority_bonus * self._is_demo(slots) + self.config.epsilon
        self.columns["priority"][slots] = priority**self.config.alpha
        self._max_priority = max(self._max_priority, float(priority.max()))

    def save(self, folder: Path) -> None:
        """Write all slots in use to a new folder."""
        folder.mkdir()
        used = [slice(first, first + count) for first, count in zip(self._first, self._written, strict=False)]
        for name, array in (self.columns | self.frames).items():
            shape = (int(self._written.sum()), *array.shape[1:])
            file = _mapped(folder / f"{name}.npy", shape, array.dtype)
            begin = 0
            for part in used:
                end = begin + part.stop - part.start
                file[begin:end] = array[part]
                begin = end
            file.flush()
        state = {"head": self._head.tolist(), "written": self._written.tolist(), "max_priority": self._max_priority}
        (folder / "state.json").write_text(json.dumps(state))

    def load(self, folder: Path) -> None:
        """Load what `save` wrote for streams of the same lengths."""
        state = json.loads((folder / "state.json").read_text())
        self._head, self._written = np.array(state["head"]), np.array(state["written"])
        self._max_priority = state["max_priority"]
        for name, array in (self.columns | self.frames).items():
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
        self.columns["priority"][slot] = 0.0
        for name, array in self.frames.items():
            array[slot] = frame[name]

    def _slot(self, stream: int) -> int:
        return int(self._first[stream] + self._head[stream])

    def _next(self, slots: NDArray[np.int64]) -> NDArray[np.int64]:
        stream = self._first.searchsorted(slots, side="right") - 1
        return np.where(slots + 1 == self._first[stream + 1], self._first[stream], slots + 1)

    def _is_demo(self, slots: NDArray[np.int64]) -> NDArray[np.bool_]:
        return slots < self._first[1]


def _allocate(shape: tuple[int, ...], dtype: np.dtype, file: Path | None) -> NDArray[Any]:
    if file is None:
        return np.zeros(shape, dtype)  # the operating system provides memory when it is written to
    file.parent.mkdir(parents=True, exist_ok=True)
    return _mapped(file, shape, dtype)


def _mapped(file: Path, shape: tuple[int, ...], dtype: np.dtype) -> np.memmap:
    return np.lib.format.open_memmap(file, "w+", dtype, shape)  # type: ignore[no-untyped-call]
