"""Where the time of an experiment's cells goes."""

from __future__ import annotations

import os
import statistics
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_symview.registry import lookup
from symview_eval.benchmarks.clock import seconds
from symview_eval.experiments.scale import SCALES

if TYPE_CHECKING:
    from symview_eval.experiments.results import Result


@dataclass(frozen=True)
class ExperimentBenchmark:
    """Cells of table 1, as many as run at once, twice over: how long they take and what for."""

    scale: str = "laptop"
    """How large: paper, laptop or smoke."""
    task: str = "block_picking"
    """Of the paper's table 1."""
    method: str = "reproj_equi"
    """Row of that table."""
    device: str = "cpu"
    """Of the networks."""
    num_workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Cells that run at once."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def __post_init__(self) -> None:
        lookup("--scale", self.scale, SCALES)
        if self.num_workers < 1:
            raise ValueError(f"--num_workers must be at least 1, got {self.num_workers}")


def benchmark_experiment(config: ExperimentBenchmark) -> dict[str, float]:
    """Return what a cell takes, and for what.

    `cell_s` is the median time of a cell, beside the others; `cells_per_hour` counts all of the command's time.
    `useful_core_share` is the processor time of trainings, evaluations and simulators to the command's time on all
    cores, start-up and recording of demonstrations included, below 1 where cores wait. Of a cell's time,
    `preparation_share`, `training_share` and `waiting_share` follow each other; evaluations take `evaluation_share`,
    most of it beside the training.
    """
    from symview_eval.experiments.experiment import ExperimentConfig, run_experiment
    from symview_eval.experiments.results import read_result

    with tempfile.TemporaryDirectory() as folder:
        experiment = ExperimentConfig(
            scale=config.scale,
            tasks=[config.task],
            methods=[config.method],
            demos=[10],
            seeds=list(range(2 * config.num_workers)),
            device=config.device,
            num_workers=config.num_workers,
            results_dir=Path(folder) / "results",
            output_dir=Path(folder) / "output",
        )
        total = seconds(lambda: run_experiment("table1", experiment))
        results = [read_result(path) for path in experiment.results_dir.rglob("*.csv")]
    parts = ("preparation", "training", "waiting", "evaluation")
    return {
        "useful_core_share": sum(result.times.cpu_s for result in results) / total / (os.cpu_count() or 1),
        "cell_s": statistics.median(result.origin.seconds for result in results),
        "cells_per_hour": 3600 * len(results) / total,
        **{f"{part}_share": statistics.median(_share(result, part) for result in results) for part in parts},
    }


def _share(result: Result, part: str) -> float:
    return float(getattr(result.times, f"{part}_s")) / result.origin.seconds
