"""Suite `experts`: success rate and episode length of the scripted experts."""

from __future__ import annotations

import statistics
from dataclasses import dataclass, field
from typing import Any

from tqdm import tqdm

from lerobot_symview.registry import lookup
from symview_sim.control import CONTROLS
from symview_sim.settings import EnvSettings
from symview_sim.tasks import TASK_NAMES, check_task


@dataclass(frozen=True)
class ExpertsBenchmark:
    """Measure the success rate and the episode length of every task's expert."""

    seeds: int = 200
    """Episodes per task; episode i has seed i."""
    control: str = "coarse"
    """Rate and size of the actions, `coarse` or `fine`."""
    tasks: list[str] = field(default_factory=lambda: list(TASK_NAMES))
    """Tasks to run."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise ValueError(f"--seeds must be at least 1, got {self.seeds}")
        lookup("--control", self.control, CONTROLS)
        for task in self.tasks:
            check_task(task)


def benchmark_experts(config: ExpertsBenchmark) -> dict[str, dict[str, float]]:
    """Run the experts.

    Returns:
        Per task: `success`, a rate in [0, 1], and `mean_length`, `min_length` and `max_length` in steps.
    """
    results = {}
    for task in config.tasks:
        env = EnvSettings(task=task, control=config.control).make()
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


def _expert_episode(env: Any) -> tuple[bool, int]:
    """Run one episode after its reset; return whether it succeeded and its number of steps."""
    length, done = 0, False
    while not done:
        _, _, terminated, truncated, info = env.step(env.expert_action())
        length, done = length + 1, terminated or truncated
    return info["is_success"], length
