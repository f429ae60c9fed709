"""`symview-benchmark`: what experts achieve, what a step, a view, an update and a run cost, as tables or JSON."""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from tqdm import tqdm

from lerobot_symview.runtime.cli import run_command, subcommand
from symview_eval.benchmarks.clock import Clock
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import EnvSettings, NewDataset
from symview_sim.tasks import TASK_NAMES, check_task

REPEATS = 50
TIMED = {
    "physics_ms": "stepSimulation",
    "inverse_kinematics_ms": "calculateInverseKinematics",
    "render_ms": "getCameraImage",
}

EXAMPLES = """\
  symview-benchmark experts --seeds=200
  symview-benchmark env --json=true
  symview-benchmark views
  symview-benchmark policy --batch_size=32
  symview-benchmark rl --policy.width=16 --policy.crop_size=64 --batch_size=32
  symview-benchmark experiment --scale=laptop"""


@dataclass(frozen=True)
class ExpertsBenchmark:
    """Success and length of the experts' episodes, per task."""

    seeds: int = 200
    """Episodes per task, from seeds 0 upwards."""
    tasks: list[str] = field(default_factory=lambda: list(TASK_NAMES))
    """Which tasks."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise ValueError(f"--seeds must be at least 1, got {self.seeds}")
        for task in self.tasks:
            check_task(task)


@dataclass(frozen=True)
class EnvBenchmark:
    """Cost of an environment's steps with one camera on one core, medians in milliseconds."""

    env: EnvSettings = field(default_factory=EnvSettings)
    """What is simulated."""
    episodes: int = 20
    """Expert episodes to time."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise ValueError(f"--episodes must be at least 1, got {self.episodes}")


def benchmark_experts(config: ExpertsBenchmark) -> dict[str, dict[str, float]]:
    """Return `success` (a rate), `mean_length`, `min_length` and `max_length` per task."""
    results = {}
    for task in config.tasks:
        env = EnvSettings(task=task).make()
        successes, lengths = 0, []
        for seed in tqdm(range(config.seeds), desc=task, unit="episode"):
            env.reset(seed=seed)
            success, length = _expert_episode(env)
            successes += success
            lengths.append(length)
        env.close()
        results[task] = {
            "success": successes / config.seeds,
            "mean_length": statistics.fmean(lengths),
            "min_length": min(lengths),
            "max_length": max(lengths),
        }
    return results


def benchmark_env(config: EnvBenchmark) -> dict[str, float]:
    """Return what a step and a reset cost and where a step's time goes, in milliseconds, and episodes per second.

    `physics_ms`, `inverse_kinematics_ms` and `render_ms` are the simulator's parts of `step_ms`, `other_ms` the rest.
    `floor_ms` is what the same number of simulation steps takes with the arm in free air and one rendering: below it
    only fewer steps or a smaller image lead. `episodes_per_s` counts simulated expert episodes, `saved_episodes_per_s`
    those written to a dataset.
    """
    env = config.env.make()
    client, arm = env.scene.client, env.scene.arm
    start = time.perf_counter()
    episodes = [
        list(_durations(env, seed)) for seed in tqdm(range(config.episodes), desc=config.env.task, unit="episode")
    ]
    simulated = config.episodes / (time.perf_counter() - start)
    step = statistics.median(milliseconds for _, *steps in episodes for milliseconds in steps)
    parts = {name: Clock(client, function) for name, function in TIMED.items()}  # which take time themselves
    spent: dict[str, list[float]] = {name: [] for name in parts}
    for seed in range(config.episodes):
        passed: dict[str, float] = {}
        for _ in _durations(env, seed):
            for name, part in parts.items():
                if name in passed:  # after a step, not after the reset
                    spent[name].append(part.milliseconds - passed[name])
                passed[name] = part.milliseconds
    env.reset(seed=0)
    before_free = parts["physics_ms"].milliseconds
    for _ in range(REPEATS):
        arm.move(arm.position, arm.yaw, 1.0)
    free = (parts["physics_ms"].milliseconds - before_free) / REPEATS
    env.close()
    costs = {name: statistics.median(values) for name, values in spent.items()}
    return {
        "step_ms": step,
        **costs,
        "other_ms": step - sum(costs.values()),
        "floor_ms": free + costs["render_ms"],
        "reset_ms": statistics.median(reset for reset, *_ in episodes),
        "episodes_per_s": simulated,
        "saved_episodes_per_s": _saved_per_second(config),
    }


def _saved_per_second(config: EnvBenchmark) -> float:
    import lerobot.datasets  # noqa: F401  imported before the clock starts: it takes longer than the writing

    recorded = RecordedEnv(**vars(config.env))
    with tempfile.TemporaryDirectory() as folder:
        target = NewDataset("benchmark/recorded", Path(folder) / "recorded")
        start = time.perf_counter()
        generate(GenerateConfig(target, env=recorded, num_episodes=config.episodes))
        return config.episodes / (time.perf_counter() - start)


def _expert_episode(env: Any) -> tuple[bool, int]:
    length, done = 0, False
    while not done:
        _, _, terminated, truncated, info = env.step(env.expert_action())
        length, done = length + 1, terminated or truncated
    return info["is_success"], length


def _durations(env: Any, seed: int) -> Iterator[float]:
    """Yield the milliseconds that the reset of an expert's episode takes, then those of every step."""
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


def _print(results: dict[str, Any], as_json: bool) -> None:
    if as_json:
        sys.stdout.write(json.dumps(results) + "\n")
        return
    for name, value in results.items():
        values = value if isinstance(value, dict) else {"": value}
        cells = "  ".join(f"{label:>11} {number:7.4g}" for label, number in values.items())
        sys.stdout.write(f"{name:28}{cells}\n")


SUITES = {
    "experts": ("symview_eval.benchmarks.benchmark", "ExpertsBenchmark", "benchmark_experts"),
    "env": ("symview_eval.benchmarks.benchmark", "EnvBenchmark", "benchmark_env"),
    "views": ("symview_eval.benchmarks.views", "ViewsBenchmark", "benchmark_views"),
    "policy": ("symview_eval.benchmarks.policy", "PolicyBenchmark", "benchmark_policy"),
    "rl": ("symview_eval.benchmarks.rl", "RlBenchmark", "benchmark_rl"),
    "experiment": ("symview_eval.benchmarks.experiment", "ExperimentBenchmark", "benchmark_experiment"),
}
"""Name -> module, configuration and function. Loaded when asked for: worker processes import this module, and PyTorch
takes longer than their work."""


def main() -> None:
    """Run the console command: the first argument names the suite."""
    module, *names = SUITES[subcommand("suite", SUITES, default="experts")]
    config_class, measure = (getattr(import_module(module), name) for name in names)
    sys.argv = [
        argument.replace("--json", "--json=true") if argument == "--json" else argument for argument in sys.argv
    ]
    run_command(config_class, lambda config: _print(measure(config), config.json), EXAMPLES)
