"""Suite `env`: time of an environment step and reset, and simulated episodes per second."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from symview_eval.benchmarks.clock import Clock
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import EnvSettings, NewDataset

FREE_MOVES = 50  # arm movements in free air that `floor_ms` averages over
SIMULATOR_FUNCTIONS = {
    "physics_ms": "stepSimulation",
    "inverse_kinematics_ms": "calculateInverseKinematics",
    "render_ms": "getCameraImage",
}


@dataclass(frozen=True)
class EnvBenchmark:
    """Measure the time of environment steps with one camera on one core, as medians in milliseconds."""

    env: EnvSettings = field(default_factory=EnvSettings)
    """The environment."""
    episodes: int = 20
    """Expert episodes to time."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise ValueError(f"--episodes must be at least 1, got {self.episodes}")


def benchmark_env(config: EnvBenchmark) -> dict[str, float]:
    """Time the steps and resets of expert episodes.

    Returns:
        Medians in milliseconds and rates per second. `step_ms` and `reset_ms` are the times of a step and a reset.
        `physics_ms`, `inverse_kinematics_ms` and `render_ms` are the simulator's parts of `step_ms`, `other_ms` is the
        rest. `floor_ms` is the time of the same number of simulation steps with the arm in free air and of one
        rendering: only fewer simulation steps or a smaller image can be faster. `episodes_per_s` counts simulated
        expert episodes, `saved_episodes_per_s` expert episodes written to a dataset.
    """
    env = config.env.make()
    client, arm = env.scene.client, env.scene.arm
    start = time.perf_counter()
    episodes = [
        list(_durations(env, seed)) for seed in tqdm(range(config.episodes), desc=config.env.task, unit="episode")
    ]
    episodes_per_second = config.episodes / (time.perf_counter() - start)
    step = statistics.median(milliseconds for _, *steps in episodes for milliseconds in steps)
    # The clocks are added after `step_ms` is measured: they take time themselves.
    clocks = {name: Clock(client, function) for name, function in SIMULATOR_FUNCTIONS.items()}
    times: dict[str, list[float]] = {name: [] for name in clocks}
    for seed in range(config.episodes):
        before: dict[str, float] = {}
        for _ in _durations(env, seed):
            for name, clock in clocks.items():
                if name in before:  # after a step, not after the reset
                    times[name].append(clock.milliseconds - before[name])
                before[name] = clock.milliseconds
    env.reset(seed=0)
    before_free = clocks["physics_ms"].milliseconds
    for _ in range(FREE_MOVES):
        arm.move(arm.position, arm.yaw, 1.0)
    free = (clocks["physics_ms"].milliseconds - before_free) / FREE_MOVES
    env.close()
    parts = {name: statistics.median(values) for name, values in times.items()}
    return {
        "step_ms": step,
        **parts,
        "other_ms": step - sum(parts.values()),
        "floor_ms": free + parts["render_ms"],
        "reset_ms": statistics.median(reset for reset, *_ in episodes),
        "episodes_per_s": episodes_per_second,
        "saved_episodes_per_s": _saved_per_second(config),
    }


def _saved_per_second(config: EnvBenchmark) -> float:
    import lerobot.datasets  # noqa: F401  imported before the clock starts: the import takes longer than the writing

    recorded = RecordedEnv(**vars(config.env))
    with tempfile.TemporaryDirectory() as folder:
        target = NewDataset("benchmark/recorded", Path(folder) / "recorded")
        start = time.perf_counter()
        generate(GenerateConfig(target, env=recorded, num_episodes=config.episodes))
        return config.episodes / (time.perf_counter() - start)


def _durations(env: Any, seed: int) -> Iterator[float]:
    """Run an expert episode; yield the milliseconds of its reset, then those of every step."""
    yield _milliseconds(env.reset, seed=seed)
    done = False
    while not done:
        action = env.expert_action()
        start = time.perf_counter()
        _, _, terminated, truncated, _ = env.step(action)
        yield 1000 * (time.perf_counter() - start)
        done = terminated or truncated


def _milliseconds(call: Callable[..., Any], *arguments: Any, **options: Any) -> float:
    start = time.perf_counter()
    call(*arguments, **options)
    return 1000 * (time.perf_counter() - start)
