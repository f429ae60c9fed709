"""What the results of several seeds say together, beside the paper's values."""

from __future__ import annotations

import csv
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from itertools import combinations
from pathlib import Path

from scipy import stats

from symview_eval.experiments.grid import Experiment, Row, select
from symview_eval.experiments.results import Checkpoint, Result, read_result
from symview_eval.experiments.scale import SCALES
from symview_eval.statistics import SuccessRate

LAST = 5  # checkpoints whose mean is told


@dataclass(frozen=True)
class Estimate:
    """A success rate over seeds and its 95 % interval, in [0, 1]."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{100 * self.mean:.1f} ({100 * self.low:.0f} to {100 * self.high:.0f})"


@dataclass(frozen=True)
class Entry:
    """A row of a table for one task and number of demonstrations."""

    row: Row
    task: str
    demonstrations: int
    results: tuple[Result, ...]
    """Of the seeds."""
    best: Estimate
    """Of the highest rate among a training's checkpoints, as the paper tells it; it is optimistic."""
    last: Estimate
    """Of the last checkpoint."""
    last_five: Estimate
    """Of the mean over the last five checkpoints."""
    paper: float
    """Rate that the paper prints, nan if it prints none."""

    @property
    def episodes(self) -> int:
        """Of the last five checkpoints of all seeds."""
        return sum(point.episodes for result in self.results for point in result.checkpoints[-LAST:])

    @property
    def difference(self) -> float:
        """`best` less the paper's."""
        return self.best.mean - self.paper


@dataclass(frozen=True)
class Ordering:
    """Two rows of a table, and how they are ordered."""

    better: Entry
    """By the paper."""
    worse: Entry

    @property
    def found(self) -> float:
        """By how much the better one is better here; below zero where it is worse."""
        return self.better.best.mean - self.worse.best.mean

    @property
    def stated(self) -> float:
        """The same in the paper."""
        return self.better.paper - self.worse.paper


def entries(experiment: Experiment, scale: str, folder: Path) -> list[Entry]:
    """Return what is known of an experiment at a scale, rows of one task and number of demonstrations together."""
    paper = paper_values(experiment.name)
    groups: dict[tuple[str, int, str], list[Result]] = {}
    rows = {row.name: row for row in experiment.rows}
    for path in sorted((folder / experiment.name / scale).glob("*/*/*/*.csv")):
        task, row, demonstrations = path.parts[-4:-1]
        if row in rows and task in experiment.tasks:
            groups.setdefault((task, int(demonstrations), row), []).append(read_result(path))
    order = {row: index for index, row in enumerate(rows)}
    tasks = {task: index for index, task in enumerate(experiment.tasks)}
    return [
        _entry(rows[row], task, demonstrations, tuple(groups[task, demonstrations, row]), paper)
        for task, demonstrations, row in sorted(groups, key=lambda key: (tasks[key[0]], key[1], order[key[2]]))
    ]


def orderings(found: Sequence[Entry]) -> list[Ordering]:
    """Return every two rows of one task and number of demonstrations that the paper puts in an order."""
    pairs = []
    for one, other in combinations(found, 2):
        comparable = (one.task, one.demonstrations) == (other.task, other.demonstrations)
        if comparable and one.paper != other.paper and not math.isnan(one.paper + other.paper):
            pairs.append(Ordering(one, other) if one.paper > other.paper else Ordering(other, one))
    return pairs


def paper_values(experiment: str) -> dict[tuple[str, int, str], float]:
    """Return (task, demonstrations, row) -> the success rate that the paper prints; figures have none."""
    file = resources.files("symview_eval.experiments") / "paper" / f"{experiment}.csv"
    if not file.is_file():
        return {}
    return {
        (line["task"], int(line["demonstrations"]), line["method"]): float(line["success_percent"]) / 100
        for line in csv.DictReader(file.read_text().splitlines())
    }


def _entry(
    row: Row, task: str, demonstrations: int, results: tuple[Result, ...], paper: dict[tuple[str, int, str], float]
) -> Entry:
    return Entry(
        row,
        task,
        demonstrations,
        results,
        _pooled([[max(result.checkpoints, key=lambda point: point.rate)] for result in results]),
        _pooled([result.checkpoints[-1:] for result in results]),
        _pooled([result.checkpoints[-LAST:] for result in results]),
        paper.get((task, demonstrations, row.name), math.nan),
    )


def _pooled(seeds: Sequence[Sequence[Checkpoint]]) -> Estimate:
    """Return the rate over all episodes of each seed's checkpoints.

    The interval is the wider of two: Student's over seeds, which vary as trainings do, and Wilson's over episodes,
    which does not vanish where the seeds happen to agree.
    """
    rates = [sum(one.successes for one in points) / sum(one.episodes for one in points) for points in seeds]
    every = [one for points in seeds for one in points]
    low, high = SuccessRate(sum(one.successes for one in every), sum(one.episodes for one in every)).interval
    mean = statistics.fmean(rates)
    if len(rates) > 1:
        half = float(stats.t.ppf(0.975, len(rates) - 1)) * statistics.stdev(rates) / math.sqrt(len(rates))
        low, high = min(low, max(0.0, mean - half)), max(high, min(1.0, mean + half))
    return Estimate(mean, low, high)


def measured_scales(experiment: Experiment, folder: Path) -> list[str]:
    """Return the scales there are results of, the largest first."""
    return [scale for scale in SCALES if any((folder / experiment.name / scale).glob("*/*/*/*.csv"))]


def is_current(entry: Entry, experiment: Experiment, scale: str) -> bool:
    """Whether all of an entry's results are of what the experiment is now."""
    seeds = [result.origin.seed for result in entry.results]
    cells = select(experiment, SCALES[scale], [entry.task], [entry.row.name], [entry.demonstrations], seeds)
    known = {cell.configuration_hash for cell in cells}
    return all(result.origin.configuration in known for result in entry.results)
