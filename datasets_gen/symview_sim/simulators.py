"""Simulators in processes of their own, whose observations come with the views that a policy sees.

A worker process imports no LeRobot and no PyTorch. What happens in it follows from the seeds and actions it is sent, so
that a worker that died, or that ran in an earlier session, is brought back to where it was by sending them again.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from typing import Any
from unittest.mock import patch

import numpy as np
import psutil
from numpy.typing import NDArray

from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_workspace
from lerobot_symview.geometry.camera import stored_camera
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import CommandError
from lerobot_symview.views import Frame, View, make_view
from symview_sim.env import EnvObservation as RawObservation
from symview_sim.env import SymviewEnv, named_features
from symview_sim.settings import EnvSettings

logger = logging.getLogger(__name__)

Observation = dict[str, NDArray[Any]]
"""Named as in a dataset: images (H, W, C), uint8 or float32 metres, and vectors."""


@dataclass(frozen=True)
class Observed:
    """What is simulated, and what of it is reported."""

    env: EnvSettings
    """The environment."""
    names: tuple[str, ...]
    """Features to report."""
    views: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Name -> options of the views to make."""
    camera: str = "side"
    """The camera they are made from."""
    workspace: dict[str, Any] = field(default_factory=dict)
    """Constructor arguments of the `Workspace` they show."""


@dataclass(frozen=True)
class Reset:
    """Begin an episode, and take actions that were taken before."""

    seed: int
    actions: tuple[NDArray[np.floating], ...] = ()


@dataclass(frozen=True)
class Step:
    """Take an action; should it end the episode, begin the next one from a seed, if there is one."""

    action: NDArray[np.floating]
    next_seed: int | None


@dataclass(frozen=True)
class Outcome:
    """What came of a command."""

    observation: Observation | None
    """What to act upon next; None after an episode's end without a next one."""
    last: Observation | None = None
    """What the episode ended with, if it ended."""
    reward: float = 0.0
    terminated: bool = False
    """Whether the episode came to its end, by success or otherwise, rather than to the limit of its length."""
    success: bool = False
    lost: bool = False
    """Whether the simulator died: the command had no effect, and an episode from `next_seed` has begun instead."""
    seconds: float = 0.0
    """Time that the simulator took."""


class Simulators:
    """Several simulators; commands are sent to all before any is waited for.

    Args:
        observed: what each simulates.
        count: how many.
    """

    def __init__(self, observed: Observed, count: int):
        self._observed = observed
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload([__name__])
        self._spare_seeds = [0] * count
        self._workers = [self._start() for _ in range(count)]

    def __len__(self) -> int:
        return len(self._workers)

    def __enter__(self) -> Simulators:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def process_ids(self) -> list[int]:
        """The processes that simulate."""
        return [process.pid or 0 for process, _ in self._workers]

    def cpu_seconds(self) -> float:
        """Return the processor time that all of them have taken."""
        used = [psutil.Process(process_id).cpu_times() for process_id in self.process_ids]
        return float(sum(times.user + times.system for times in used))

    def is_alive(self, index: int) -> bool:
        """Whether a simulator's process runs."""
        return bool(self._workers[index][0].is_alive())

    def send(self, index: int, command: Reset | Step) -> None:
        """Have a simulator begin; `receive` must follow before the next command."""
        seed = command.seed if isinstance(command, Reset) else command.next_seed
        self._spare_seeds[index] = 0 if seed is None else seed
        with suppress(BrokenPipeError, ConnectionResetError):  # it died, as `receive` finds out
            self._workers[index][1].send(command)

    def receive(self, index: int) -> Outcome:
        """Wait for what came of the last command.

        Raises:
            CommandError: if a simulator that was started in place of one that died dies too.
        """
        with suppress(EOFError, ConnectionResetError):
            return self._workers[index][1].recv()
        process, connection = self._workers[index]
        connection.close()
        process.join()
        logger.warning(
            "simulator %d died (exit code %s): its episode is lost, another takes its place", index, process.exitcode
        )
        self._workers[index] = self._start()
        try:
            self._workers[index][1].send(Reset(self._spare_seeds[index]))
            begun = self._workers[index][1].recv()
        except (EOFError, BrokenPipeError, ConnectionResetError):
            raise CommandError(
                f"simulator {index} dies as soon as it is started: see the messages above, and try symview-doctor"
            ) from None
        return Outcome(begun.observation, lost=True)

    def close(self) -> None:
        """End all processes."""
        for process, connection in self._workers:
            connection.close()
            process.join(timeout=5)
            if process.is_alive():
                process.kill()
        self._workers = []

    def _start(self) -> tuple[Any, Connection]:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_simulate, args=(theirs, self._observed), daemon=True)
        with _unseen_main():
            process.start()
        theirs.close()
        return process, ours


@contextmanager
def _unseen_main() -> Iterator[None]:
    """Keep processes from importing the program that starts them, which takes a trainer's seconds in each of them."""
    main = sys.modules["__main__"]
    with patch.object(main, "__file__", None, create=True), patch.object(main, "__spec__", None, create=True):
        yield


def _simulate(connection: Connection, observed: Observed) -> None:
    """Carry out commands until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that trains, which ends this one
    env = observed.env.make()
    views = [make_view(name, **options) for name, options in observed.views.items()]
    workspace = parse_workspace(observed.workspace)

    def report(raw: RawObservation) -> Observation:
        return _observation(raw, observed, views, workspace)

    while True:
        try:
            command = connection.recv()
        except EOFError:
            env.close()
            return
        start = time.perf_counter()
        outcome = _carry_out(command, env, report)
        connection.send(replace(outcome, seconds=time.perf_counter() - start))


def _carry_out(command: Reset | Step, env: SymviewEnv, report: Callable[[RawObservation], Observation]) -> Outcome:
    if isinstance(command, Reset):
        raw, _ = env.reset(seed=command.seed)
        for action in command.actions:
            raw = env.step(action)[0]
        return Outcome(report(raw))
    raw, reward, terminated, truncated, info = env.step(command.action)
    observation: Observation | None = report(raw)
    last = None
    if terminated or truncated:
        last, observation = observation, None
        if command.next_seed is not None:
            observation = report(env.reset(seed=command.next_seed)[0])
    return Outcome(observation, last, reward, terminated, info["is_success"])


def _observation(raw: RawObservation, observed: Observed, views: Sequence[View], workspace: Workspace) -> Observation:
    features = named_features(raw)
    camera, depth = observed.camera, keys.depth(observed.camera)
    for view in views:
        rgb = features[keys.rgb(camera)]
        frame = Frame(
            rgb,
            features[depth][..., 0] if depth in features else None,
            stored_camera(features[keys.intrinsics(camera)], features[keys.world_from_cam(camera)], *rgb.shape[:2]),
            workspace,
            features[keys.STATE],
        )
        for output, image in view.render(frame).items():
            features[keys.view(camera, output)] = image if image.ndim == 3 else image[..., None]
    return {name: features[name] for name in observed.names}
