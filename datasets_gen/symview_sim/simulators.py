"""Simulators in separate processes. Their observations include the views that a policy uses.

A worker process imports neither LeRobot nor PyTorch. Its state follows from the seeds and actions that it receives:
sending them again restores the state of a worker that died or that ran in an earlier session.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
import sys
import time
from collections.abc import Iterator, Sequence
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
from lerobot_symview.geometry.gripper_state import gripper_columns, poses_from_states
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import CommandError
from lerobot_symview.views import Frame, View, ViewSpec, other_cameras
from symview_sim.camera_rig import EnvObservation as RawObservation
from symview_sim.camera_rig import named_features
from symview_sim.settings import WorldSettings
from symview_sim.table_env import TableEnv, checked_action

logger = logging.getLogger(__name__)

Observation = dict[str, NDArray[Any]]
"""Values by dataset key: images (H, W, C), uint8 or float32 metres, and vectors."""


@dataclass(frozen=True)
class SimulatorConfig:
    """The environment to simulate and the features to report."""

    env: WorldSettings
    """The environment."""
    names: tuple[str, ...]
    """Features to report."""
    views: tuple[ViewSpec, ...] = ()
    """Views to make."""
    camera: str = "side"
    """The camera they are made from."""
    workspace: dict[str, Any] = field(default_factory=dict)
    """Constructor arguments of the `Workspace` they show."""


@dataclass(frozen=True)
class Reset:
    """Begin an episode and repeat the actions taken so far."""

    seed: int
    actions: tuple[NDArray[np.floating], ...] = ()


@dataclass(frozen=True)
class Step:
    """Take an action. If it ends the episode, begin the next one from `next_seed`, unless that is None."""

    action: NDArray[np.floating]
    next_seed: int | None


@dataclass(frozen=True)
class Outcome:
    """The result of a command."""

    observation: Observation | None
    """The observation for the next action; None if the episode has ended and no other follows."""
    last: Observation | None = None
    """The last observation of an episode that has ended, else None."""
    reward: float = 0.0
    terminated: bool = False
    """Whether the episode ended by success or failure, rather than by its maximum length."""
    success: bool = False
    lost: bool = False
    """Whether the simulator died. The command had no effect; an episode from `next_seed` has begun instead."""
    seconds: float = 0.0
    """Time that the simulator took, seconds."""


class Simulators:
    """Several simulators that run in parallel: send a command to each, then receive each result.

    Args:
        config: environment and features of each simulator.
        count: number of simulators.
    """

    def __init__(self, config: SimulatorConfig, count: int):
        self._config = config
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
        """Process ids of the simulators."""
        return [process.pid or 0 for process, _ in self._workers]

    def cpu_seconds(self) -> float:
        """Return the CPU time that all running simulators have used, seconds."""
        seconds = 0.0
        for process_id in self.process_ids:
            with suppress(psutil.NoSuchProcess):  # `receive` replaces one that has died
                times = psutil.Process(process_id).cpu_times()
                seconds += times.user + times.system
        return seconds

    def is_alive(self, index: int) -> bool:
        """Whether a simulator's process is running."""
        return bool(self._workers[index][0].is_alive())

    def send(self, index: int, command: Reset | Step) -> None:
        """Send a command to a simulator. Call `receive` before the next command.

        Raises:
            ValueError: if a step's action is not as many finite numbers as the environment takes. Raised here: in the
                simulator it would end it.
        """
        if isinstance(command, Step):
            checked_action(command.action, self._config.env.action_names)
        seed = command.seed if isinstance(command, Reset) else command.next_seed
        self._spare_seeds[index] = 0 if seed is None else seed
        with suppress(BrokenPipeError, ConnectionResetError):  # it died; `receive` handles this
            self._workers[index][1].send(command)

    def receive(self, index: int) -> Outcome:
        """Wait for the result of the last command. A simulator that has died is replaced.

        Raises:
            CommandError: if the replacement dies too.
        """
        with suppress(EOFError, ConnectionResetError):
            return self._workers[index][1].recv()
        process, connection = self._workers[index]
        connection.close()
        process.join()
        logger.warning(
            "simulator %d died (exit code %s): its episode is lost, a new simulator replaces it",
            index,
            process.exitcode,
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
        """Stop all processes."""
        for process, connection in self._workers:
            connection.close()
            process.join(timeout=5)
            if process.is_alive():
                process.kill()
        self._workers = []

    def _start(self) -> tuple[Any, Connection]:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_simulate, args=(theirs, self._config), daemon=True)
        with _unseen_main():
            process.start()
        theirs.close()
        return process, ours


@contextmanager
def _unseen_main() -> Iterator[None]:
    """Prevent new processes from importing the main program, which takes several seconds for a trainer."""
    main = sys.modules["__main__"]
    with patch.object(main, "__file__", None, create=True), patch.object(main, "__spec__", None, create=True):
        yield


def _simulate(connection: Connection, config: SimulatorConfig) -> None:
    """Execute commands until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C stops the training process, which stops this one
    env = config.env.make()
    views = [spec.make() for spec in config.views]
    workspace = parse_workspace(config.workspace)

    report = _Reporter(config, views, workspace)
    while True:
        try:
            command = connection.recv()
        except EOFError:
            env.close()
            return
        start = time.perf_counter()
        outcome = _carry_out(command, env, report)
        connection.send(replace(outcome, seconds=time.perf_counter() - start))


def _carry_out(command: Reset | Step, env: TableEnv, report: _Reporter) -> Outcome:
    if isinstance(command, Reset):
        raw, _ = env.reset(seed=command.seed)
        report.start_episode()
        for action in command.actions:
            if report.remembers:
                report(raw)
            raw = env.step(action)[0]
        return Outcome(report(raw))
    raw, reward, terminated, truncated, info = env.step(command.action)
    observation: Observation | None = report(raw)
    last = None
    if terminated or truncated:
        last, observation = observation, None
        if command.next_seed is not None:
            report.start_episode()
            observation = report(env.reset(seed=command.next_seed)[0])
    return Outcome(observation, last, reward, terminated, info["is_success"])


class _Reporter:
    """Makes the reported features of the observations of an episode, views included."""

    def __init__(self, config: SimulatorConfig, views: Sequence[View], workspace: Workspace):
        self._config, self._views, self._workspace = config, views, workspace
        self._columns = gripper_columns(config.env.state_names)
        self.remembers = any(view.memory for view in views)
        self.start_episode()

    def start_episode(self) -> None:
        """Forget the frames of the last episode."""
        self._renderers = [view.start_episode() for view in self._views]

    def __call__(self, raw: RawObservation) -> Observation:
        """Return the features of an observation."""
        features, camera = named_features(raw), self._config.camera
        if self._renderers:
            others = {name: self._frame(features, name) for name in other_cameras(self._views, camera)}
            frame = replace(self._frame(features, camera), others=others)
            for render in self._renderers:
                for output, image in render(frame).items():
                    features[keys.view(camera, output)] = image if image.ndim == 3 else image[..., None]
        return {name: features[name] for name in self._config.names}

    def _frame(self, features: Observation, camera: str) -> Frame:
        rgb, depth = features[keys.rgb(camera)], features.get(keys.depth(camera))
        numbers = {keys.parameter(key): features[key] for key in keys.calibration(camera, features)}
        calibrated = stored_camera(height=rgb.shape[0], width=rgb.shape[1], **numbers)
        gripper = None if self._columns is None else poses_from_states(features[keys.STATE], self._columns)
        return Frame(rgb, None if depth is None else depth[..., 0], calibrated, self._workspace, gripper)
