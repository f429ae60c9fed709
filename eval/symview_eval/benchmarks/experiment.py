"""Suite `experiment`: time of an experiment's cells and its parts."""

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
    """Measure the time of cells of table 1 and its parts, over twice as many cells as run at once."""

    scale: str = "laptop"
    """Size of the runs: paper, laptop or smoke."""
    task: str = "block_picking"
    """Task, one of the paper's table 1."""
    method: str = "reproj_equi"
    """Method, one row of that table."""
    device: str = "cpu"
    """PyTorch device of the networks, such as cpu or cuda."""
    num_workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Cells that run in parallel."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def __post_init__(self) -> None:
        lookup("--scale", self.scale, SCALES)
        if self.num_workers < 1:
            raise ValueError(f"--num_workers must be at least 1, got {self.num_workers}")


def benchmark_experiment(config: ExperimentBenchmark) -> dict[str, float]:
    """Run the cells and time them.

    Returns:
        `cell_s`: median time of a cell while the others run, seconds. `cells_per_hour`: cells over the command's whole
        time. `useful_core_share`: CPU time of trainings, evaluations and simulators over the command's time times the
        number of cores; the command's time includes start-up and the recording of demonstrations, and idle cores lower
        the share. `preparation_share`, `training_share` and `waiting_share`: consecutive parts of a cell's time.
        `evaluation_share`: evaluations, most of them in parallel with the training.
    """
    from symview_eval.experiments.cli import ExperimentConfig, run_experiment
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
