"""`symview-experiment`: reruns tables and figures of the paper, and reports the results beside the paper's."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import batched
from pathlib import Path
from typing import Any

from tqdm import tqdm

from lerobot_symview.registry import lookup
from lerobot_symview.runtime.cli import CommandError, run_command, subcommand
from lerobot_symview.runtime.executors import EXECUTORS
from lerobot_symview.runtime.locking import RUN_LOCK, locked
from symview_eval.experiments.grid import Cell
from symview_eval.experiments.queue import ALL, Costs, chosen_cells, distinct, remaining
from symview_eval.experiments.report import ReportConfig, report
from symview_eval.experiments.results import copy_shared, finished_results, unfinished_cells
from symview_eval.experiments.scale import SCALES
from symview_eval.experiments.tables import EXPERIMENTS

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-experiment table1 --scale=smoke
  symview-experiment table1 --tasks='[block_picking]' --methods='[reproj_equi, sideview_equi]' --demos='[10]'
  symview-experiment figure7 --scale=paper --device=cuda --num_workers=2
  symview-experiment chunks --tasks='[block_picking]' --demos='[10, 100]' --seeds='[0]'
  symview-experiment all --scale=laptop --num_workers=1 --dry_run
  symview-experiment report

The first argument is the experiment (table1 to table5, figure5 to figure7, transfer, robustness, lens, hidden,
metaworld, metaworld_moved, chunks, chunks_planner, chunks_moved), all of them (all), or report, which rebuilds the
tables and plots of all results."""

BATCH = 8  # cells per worker whose demonstrations are recorded together, before they run


@dataclass(frozen=True)
class ExperimentConfig:
    """Rerun a table or figure of the paper. Cells that have a result are not run again."""

    scale: str = "laptop"
    """Size of the runs: paper, laptop or smoke."""
    tasks: list[str] = field(default_factory=list)
    """Tasks to run; by default all of the experiment's."""
    methods: list[str] = field(default_factory=list)
    """Methods to run, by the names of their result folders; by default all of the experiment's."""
    demos: list[int] = field(default_factory=list)
    """Numbers of demonstrations to run; by default all of the experiment's."""
    seeds: list[int] = field(default_factory=list)
    """Seeds to run; by default 0, 1, … up to the scale's number of seeds."""
    device: str = "cpu"
    """PyTorch device of the networks: cpu, cuda or mps."""
    num_workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Cells that run in parallel; by default one per core, since each network uses one CPU thread."""
    executor: str = "local"
    """`local` (processes) or `ray` (the cluster at RAY_ADDRESS, whose machines share these folders, or a local one)."""
    results_dir: Path = Path("results")
    """Folder of results: `<table>/<scale>/<task>/<method>/<demonstrations>/<seed>.csv`."""
    output_dir: Path = Path("outputs/experiments")
    """Folder of demonstrations and policies."""
    dry_run: bool = False
    """Print the cells that are left and the time they take, and run nothing."""

    def __post_init__(self) -> None:
        lookup("--scale", self.scale, SCALES)
        lookup("--executor", self.executor, EXECUTORS)
        if self.num_workers < 1:
            raise ValueError(f"--num_workers must be at least 1, got {self.num_workers}")
        for flag, minimum in (("demos", 1), ("seeds", 0)):
            if any(value < minimum for value in getattr(self, flag)):
                raise ValueError(f"--{flag} must be at least {minimum}, got {getattr(self, flag)}")


def run_experiment(name: str, config: ExperimentConfig) -> list[Cell]:
    """Run the cells that `config` selects and that have no result yet.

    Args:
        name: key of `EXPERIMENTS`, such as `table1`, or `all`.
        config: which cells, how and where.

    Returns:
        All selected cells, with and without an earlier result.

    Raises:
        CommandError: if cells failed, raised after all others have finished, or if another run uses the output folder.
        ValueError: if the experiment has no such task or method.
    """
    scale = SCALES[config.scale]
    finished = finished_results(config.results_dir, config.scale)
    costs = Costs.measured(finished)
    cells = chosen_cells(name, scale, config.tasks, config.methods, config.demos, config.seeds, costs)
    logger.info("%s", "all tables and figures" if name == ALL else f"{EXPERIMENTS[name].title}, {name}")
    logger.info("scale: %s", scale)
    os.environ["HF_HUB_OFFLINE"] = "1"
    missing = unfinished_cells(cells, finished)
    for line in remaining(cells, missing, costs):
        logger.info("%s", line)
    if config.dry_run:
        return cells
    copy_shared(cells, config.results_dir, finished)
    if missing:
        with locked(config.output_dir / RUN_LOCK, config.output_dir, "--output_dir"):
            _run(missing, config)
    return cells


def _run(cells: Sequence[Cell], config: ExperimentConfig) -> None:
    runs, failures = distinct(cells), []
    with (
        EXECUTORS[config.executor](config.num_workers, "symview_eval.experiments.cells") as executor,
        tqdm(desc="cells", total=len(runs), unit="cell") as bar,
    ):
        # slow imports, in parallel with the same imports in the executor's workers
        from symview_eval.experiments.cells import CellJob, Outcome, record_demonstrations, run_cell

        def run(function: Callable[[CellJob], Outcome], jobs: Sequence[CellJob]) -> list[Outcome]:
            """Return the failures."""
            failed = []
            for outcome in executor.run(function, jobs):
                if outcome.failure:
                    tqdm.write(f"failed: {outcome.cell}: {outcome.failure}", file=sys.stderr)
                    failed.append(outcome)
                elif function is run_cell:
                    bar.set_postfix_str(f"{outcome.cell} took {outcome.seconds:.0f} s", refresh=False)
                bar.update(function is run_cell)
            return failed

        results, folder = config.results_dir.resolve(), config.output_dir.resolve()
        for batch in batched(runs, BATCH * config.num_workers):
            jobs = [CellJob(cell, results, folder, config.device) for cell in batch]
            unrecorded = run(record_demonstrations, list({job.cell.recording: job for job in jobs}.values()))
            reasons = {outcome.cell.recording: outcome.failure for outcome in unrecorded}
            failures += [
                Outcome(job.cell, 0.0, reasons[job.cell.recording]) for job in jobs if job.cell.recording in reasons
            ]
            failures += run(run_cell, [job for job in jobs if job.cell.recording not in reasons])
            copy_shared(cells, config.results_dir, finished_results(config.results_dir, config.scale))
    if failures:
        first = "; ".join(f"{outcome.cell}: {outcome.failure}" for outcome in failures[:3])
        raise CommandError(
            f"{len(failures)} of {len(runs)} cells failed; run the same command again to retry them: {first}"
        )


def main() -> None:
    """Run the console command: the first argument names the table or figure, or is `all` or `report`."""
    commands: dict[str, Any] = dict.fromkeys([*EXPERIMENTS, ALL], run_experiment) | {"report": report}
    name = subcommand("experiment", commands)
    if name == "report":
        run_command(ReportConfig, report, EXAMPLES)
    run_command(ExperimentConfig, lambda config: run_experiment(name, config), EXAMPLES)
