"""Suite `rl`: time of a joint step of reinforcement learning, of its parts and of a replay sample."""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tqdm import tqdm

from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from symview_eval.benchmarks.clock import seconds
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import EnvSettings, NewDataset
from symview_sim.simulators import Reset, Simulators, Step

if TYPE_CHECKING:
    from lerobot_policy_symview.rl.replay import Replay
    from lerobot_policy_symview.rl.training import Training

DEMONSTRATIONS = 20
SAMPLES = 50
BETA = 0.4


@dataclass(frozen=True)
class RlBenchmark:
    """Measure a joint step, in which simulators and updates overlap, and a replay sample, at the paper's sizes."""

    env: EnvSettings = field(default_factory=EnvSettings)
    """The environment."""
    policy: SymviewSacfdConfig = field(default_factory=SymviewSacfdConfig)
    """The policy."""
    batch_size: int = 128
    """Transitions per update."""
    num_simulators: int = 5
    """Simulators in parallel."""
    rounds: int = 5
    """Joint steps to time, each followed by its parts."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def __post_init__(self) -> None:
        for name in ("batch_size", "num_simulators", "rounds"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} must be at least 1, got {getattr(self, name)}")


def benchmark_rl(config: RlBenchmark) -> dict[str, float]:
    """Time joint steps, the network alone and the simulators alone in turn, and replay samples.

    Returns:
        Medians over rounds. `joint_step_s`: a joint step. `network_s`: its acting and updating alone. `simulation_s`: a
        step of all simulators alone. `joint_step_ratio`: the first over the larger of the other two; 1 is perfect
        overlap. Shares of a joint step's time: `network_share`, acting and updating; `waiting_share`, waiting for the
        simulators after that; `simulation_share`, the slowest simulator's work. `sample_ms`: drawing a batch in its
        stored form. `sample_floor_ms`: copying as many contiguous bytes. `bytes_per_transition`: size in the replay.
    """
    from lerobot_policy_symview.rl.demonstrations import open_dataset
    from lerobot_policy_symview.rl.train_config import TrainRlConfig
    from lerobot_policy_symview.rl.training import Training

    with tempfile.TemporaryDirectory() as folder:
        target = NewDataset("benchmark/recorded", Path(folder) / "recorded")
        generate(GenerateConfig(target, env=RecordedEnv(**vars(config.env)), num_episodes=DEMONSTRATIONS))
        training_config = TrainRlConfig(
            dataset=target,
            env=config.env,
            policy=config.policy,
            output_dir=Path(folder),
            batch_size=config.batch_size,
            num_simulators=config.num_simulators,
        )
        with (
            Training(training_config, open_dataset(training_config.dataset)) as training,
            Simulators(training.simulator_config, config.num_simulators) as alone,
        ):
            training.start()
            costs = _joint_steps(config, training, alone)
            samples = _samples(config, training.replay)
            total = training.seconds["total"]
            shares = {f"{name}_share": training.seconds[name] / total for name in ("network", "waiting", "simulation")}
            return {
                "joint_step_ratio": costs["joint_step_s"] / max(costs["network_s"], costs["simulation_s"]),
                **costs,
                **shares,
                **samples,
                "bytes_per_transition": training.replay.bytes_per_transition,
            }


def _joint_steps(config: RlBenchmark, training: Training, alone: Simulators) -> dict[str, float]:
    rng = np.random.default_rng(0)
    space: Any = config.env.make().action_space

    def step_all(command: Callable[[int], Reset | Step]) -> None:
        for index in range(len(alone)):
            alone.send(index, command(index))
        for index in range(len(alone)):
            alone.receive(index)

    def learn() -> None:
        training.act()
        training.learn()

    step_all(Reset)
    parts: dict[str, Callable[[], object]] = {
        "joint_step_s": training.joint_step,
        "network_s": learn,
        "simulation_s": lambda: step_all(lambda index: Step(rng.uniform(space.low, space.high), index)),
    }
    times: dict[str, list[float]] = {name: [] for name in parts}
    for part in parts.values():
        part()  # warm-up, not counted
    training.seconds = dict.fromkeys(training.seconds, 0.0)
    for _ in tqdm(range(config.rounds), desc="joint steps", unit="round"):
        for name, part in parts.items():
            times[name].append(seconds(part))
    return {name: statistics.median(values) for name, values in times.items()}


def _samples(config: RlBenchmark, replay: Replay) -> dict[str, float]:
    rng = np.random.default_rng(0)
    sample = replay.sample(config.batch_size, BETA, rng)
    sources = [torch.zeros_like(frames) for frames in sample.frames.values()]
    targets = [torch.zeros_like(frames) for frames in sources]

    def copy() -> None:
        for source, target in zip(sources, targets, strict=True):
            target.copy_(source)

    times = [(seconds(lambda: replay.sample(config.batch_size, BETA, rng)), seconds(copy)) for _ in range(SAMPLES)]
    drawn, copied = (1000 * statistics.median(column) for column in zip(*times, strict=True))
    return {"sample_ms": drawn, "sample_floor_ms": copied}
