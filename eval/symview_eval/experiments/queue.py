"""Which cells to run, in which order, and how much time those that are left take."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_symview.registry import lookup
from symview_eval.experiments.grid import Cell, select
from symview_eval.experiments.results import Result
from symview_eval.experiments.rows import MethodRow
from symview_eval.experiments.scale import Scale
from symview_eval.experiments.simulators import FOREIGN_TASKS
from symview_eval.experiments.tables import EXPERIMENTS, Experiment
from symview_sim.tasks import TASK_NAMES

ALL = "all"
FIRST_TASKS = ("block_picking", "drawer_opening")  # of the figures
FIRST_FOREIGN_TASKS = ("push-v3", "pick-place-v3", "reach-v3", "plate-slide-v3")
TRANSFER_TASKS = ("block_picking", "block_pushing", "drawer_opening")
FIRST_CHUNK_TASKS = ("block_picking", "block_pushing", "block_stacking")


@dataclass(frozen=True)
class Costs:
    """Processor seconds that cells took: of the same method and task, else of the method, else of all cells."""

    medians: dict[tuple[str, ...], float] = field(default_factory=dict)

    @classmethod
    def measured(cls, finished: dict[Path, Result]) -> Costs:
        """Return the costs of `finished_results`."""
        seconds: dict[tuple[str, ...], list[float]] = {}
        for path, result in finished.items():
            table, _, task, row = path.parts[:4]  # as in `Cell.path`
            is_measured = not math.isnan(result.times.cpu_s)
            if is_measured and row in (rows := {row.name: row for row in EXPERIMENTS[table].rows}):
                for key in _keys(EXPERIMENTS[table], rows[row], task):
                    seconds.setdefault(key, []).append(result.times.cpu_s)
        return cls({key: statistics.median(values) for key, values in seconds.items()})

    def seconds(self, cell: Cell) -> float | None:
        """Return the expected seconds of a cell; None before any cell of its algorithm is finished."""
        for key in _keys(EXPERIMENTS[cell.experiment], cell.row, cell.task):
            if key in self.medians:
                return self.medians[key]
        return None


def _keys(experiment: Experiment, row: MethodRow, task: str) -> list[tuple[str, ...]]:
    kind = experiment.name if experiment.placements or row.chunks else experiment.algorithm
    method = row.name if row.chunks else row.policy["method"]
    return list(dict.fromkeys([(kind, row.name, task), (kind, method, task), (kind, method), (kind,)]))


def chosen_cells(
    name: str,
    scale: Scale,
    tasks: Sequence[str],
    methods: Sequence[str],
    demos: Sequence[int],
    seeds: Sequence[int],
    costs: Costs,
) -> list[Cell]:
    """Return the cells of an experiment in its own order, or those of all experiments, the most telling first.

    Args:
        name: key of `EXPERIMENTS`, or `all`.
        scale: size of the runs.
        tasks: as for `select`, like the three arguments below. With `all`, an experiment may lack some of them.
        methods: names of method rows.
        demos: numbers of demonstrations.
        seeds: seeds.
        costs: among equally telling cells of a seed, cheap ones come first.

    Raises:
        ValueError: if there is no such task or method.
    """
    if name != ALL:
        return select(EXPERIMENTS[name], scale, tasks, methods, demos, seeds)
    rows = {row.name: row for experiment in EXPERIMENTS.values() for row in experiment.rows}
    known = (*TASK_NAMES, *FOREIGN_TASKS)
    for task in tasks:
        lookup("--tasks entry", task, dict.fromkeys(known))
    for method in methods:
        lookup("--methods entry", method, rows)
    cells = [cell for experiment in EXPERIMENTS.values() for cell in select(experiment, scale, seeds=seeds)]
    cells = [
        cell
        for cell in cells
        if cell.task in (tasks or known)
        and cell.row.name in (methods or rows)
        and cell.demonstrations in (demos or [cell.demonstrations])
    ]
    return sorted(cells, key=lambda cell: (_rank(cell), cell.seed, costs.seconds(cell) or 0.0))


def _rank(cell: Cell) -> int:
    """Return how soon a cell is run: tables 1 and 2 at 10 demonstrations, ablations, figures and cameras, the rest."""
    if cell.experiment in ("table1", "table2") and cell.demonstrations == 10:
        return 0
    if cell.experiment in ("table3", "table4", "table5") and cell.seed < 2:
        return 1
    if cell.experiment.startswith("figure") and cell.task in FIRST_TASKS:
        return 2
    if cell.experiment in ("transfer", "robustness", "lens", "hidden") and cell.task in TRANSFER_TASKS:
        return 2
    if cell.experiment in ("chunks", "chunks_moved") and cell.task in FIRST_CHUNK_TASKS:
        return 2
    if cell.experiment.startswith("metaworld") and (cell.task in FIRST_FOREIGN_TASKS or cell.seed == 0):
        return 2
    return 3


def distinct(cells: Iterable[Cell]) -> list[Cell]:
    """Return the cells without those that repeat another one's configuration; one run serves both."""
    first: dict[str, Cell] = {}
    for cell in cells:
        first.setdefault(cell.configuration_hash, cell)
    return list(first.values())


def remaining(cells: Sequence[Cell], missing: Sequence[Cell], costs: Costs) -> list[str]:
    """Return lines that say how many cells are left, and the hours that they take on one core."""
    lines = []
    for name in sorted({cell.experiment for cell in cells}):
        count, left = (sum(cell.experiment == name for cell in group) for group in (cells, missing))
        lines.append(f"{name}: {count - left} of {count} cells have a result")
    runs = distinct(missing)
    seconds = [costs.seconds(cell) for cell in runs]
    known = [value for value in seconds if value is not None]
    if not runs:
        return lines
    hours = f"{sum(known) / 3600:.1f} hours of one core"
    unknown = f", and {len(runs) - len(known)} runs of unknown time" if len(known) < len(runs) else ""
    return [*lines, f"{len(runs)} runs are left, which serve {len(missing)} cells: {hours}{unknown}"]
