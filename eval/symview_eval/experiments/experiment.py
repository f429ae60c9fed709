"""`symview-experiment`: reruns a table or figure of the paper, and shows what was found beside what it says."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from lerobot_symview.registry import lookup
from lerobot_symview.runtime.cli import CommandError, run_command, subcommand
from lerobot_symview.runtime.executors import EXECUTORS
from symview_eval.experiments.grid import EXPERIMENTS, Cell, select
from symview_eval.experiments.report import ReportConfig, report
from symview_eval.experiments.results import finished, unfinished
from symview_eval.experiments.scale import SCALES

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-experiment table1 --scale=smoke
  symview-experiment table1 --tasks='[block_picking]' --methods='[reproj_equi, sideview_equi]' --demos='[10]'
  symview-experiment figure7 --scale=paper --device=cuda --num_workers=2
  symview-experiment report"""


@dataclass(frozen=True)
class ExperimentConfig:
    """Rerun a table or figure of the paper; what is finished is not run again."""

    scale: str = "laptop"
    """How large: paper, laptop or smoke."""
    tasks: list[str] = field(default_factory=list)
    """Which tasks; by default all of the experiment's."""
    methods: list[str] = field(default_factory=list)
    """Which rows, by the names of their folders; by default all."""
    demos: list[int] = field(default_factory=list)
    """Numbers of demonstrations; by default all of the experiment's."""
    seeds: list[int] = field(default_factory=list)
    """Which seeds; by default as many as the scale has."""
    device: str = "cpu"
    """Of the networks: cpu, cuda, mps."""
    num_workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Cells that run at once; by default one per core, since a CPU's networks use one thread each."""
    executor: str = "local"
    """`local`, or `ray`: the cluster that RAY_ADDRESS names, whose machines see the same folders, or a local one."""
    results_dir: Path = Path("results")
    """Where results are kept, as `<table>/<scale>/<task>/<method>/<demonstrations>/<seed>.csv`."""
    output_dir: Path = Path("outputs/experiments")
    """Where demonstrations and policies are kept."""

    def __post_init__(self) -> None:
        lookup("--scale", self.scale, SCALES)
        lookup("--executor", self.executor, EXECUTORS)
        if self.num_workers < 1:
            raise ValueError(f"--num_workers must be at least 1, got {self.num_workers}")
        for flag, least in (("demos", 1), ("seeds", 0)):
            if any(value < least for value in getattr(self, flag)):
                raise ValueError(f"--{flag} must be at least {least}, got {getattr(self, flag)}")


def run_experiment(name: str, config: ExperimentConfig) -> list[Cell]:
    """Run the cells that `config` selects and that have no result yet; return all that it selects.

    Raises:
        CommandError: after all others are done, if cells failed.
        ValueError: if the experiment has no such task or method.
    """
    scale = SCALES[config.scale]
    cells = select(EXPERIMENTS[name], scale, config.tasks, config.methods, config.demos, config.seeds)
    logger.info("%s, %s", EXPERIMENTS[name].title, name)
    logger.info("scale: %s", scale)
    os.environ["HF_HUB_OFFLINE"] = "1"
    missing = list(unfinished(cells, config.results_dir, finished(config.results_dir, config.scale)))
    logger.info("%d cells, %d of them finished before", len(cells), len(cells) - len(missing))
    if missing:
        _run(missing, config)
    return cells


def _run(cells: Sequence[Cell], config: ExperimentConfig) -> None:
    results, folder = config.results_dir.resolve(), config.output_dir.resolve()
    with EXECUTORS[config.executor](config.num_workers, "symview_eval.experiments.cells") as executor:
        from symview_eval.experiments.cells import Done, Job, record, run_cell  # while the executor does so, too

        jobs = [Job(cell, results, folder, config.device) for cell in cells]
        recordings = {job.cell.recording: job for job in jobs}.values()
        recorded = tqdm(executor.run(record, recordings), desc="demonstrations", total=len(recordings), unit="dataset")
        lost = {done.cell.recording: done.failure for done in recorded if done.failure}
        failures = [Done(job.cell, 0.0, lost[job.cell.recording]) for job in jobs if job.cell.recording in lost]
        for done in failures:
            tqdm.write(f"failed: {done.cell}: {done.failure}", file=sys.stderr)
        possible = [job for job in jobs if job.cell.recording not in lost]
        with tqdm(desc="cells", total=len(possible), unit="cell") as bar:
            for done in executor.run(run_cell, possible):
                if done.failure:
                    failures.append(done)
                    tqdm.write(f"failed: {done.cell}: {done.failure}", file=sys.stderr)
                else:
                    bar.set_postfix_str(f"{done.cell} took {done.seconds:.0f} s", refresh=False)
                bar.update()
    if failures:
        reasons = "; ".join(f"{done.cell}: {done.failure}" for done in failures[:3])
        raise CommandError(f"{len(failures)} of {len(cells)} cells failed, the same command runs them again: {reasons}")


def main() -> None:
    """Run the console command: the first argument names the table or figure, or is `report`."""
    commands: dict[str, Any] = dict.fromkeys(EXPERIMENTS, run_experiment) | {"report": report}
    name = subcommand("experiment", commands)
    if name == "report":
        run_command(ReportConfig, report, EXAMPLES)
    run_command(ExperimentConfig, lambda config: run_experiment(name, config), EXAMPLES)
