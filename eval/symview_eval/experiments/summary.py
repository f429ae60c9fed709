"""Success rates over seeds with their intervals, and their differences from the paper's values."""

from __future__ import annotations

import csv
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy import stats

from symview_eval.experiments.grid import select
from symview_eval.experiments.results import Checkpoint, Result, read_result
from symview_eval.experiments.rows import MethodRow
from symview_eval.experiments.scale import SCALES
from symview_eval.experiments.tables import Experiment
from symview_eval.statistics import SuccessRate

LAST_CHECKPOINTS = 5  # checkpoints whose mean is reported
RESAMPLES = 10_000  # of the bootstrap: a standard error of at most half a percent


@dataclass(frozen=True)
class Estimate:
    """A success rate over seeds and its 95 % interval, all in [0, 1]."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{100 * self.mean:.1f} ({100 * self.low:.0f} to {100 * self.high:.0f})"


@dataclass(frozen=True)
class Entry:
    """Results of one method, task and number of demonstrations."""

    row: MethodRow
    task: str
    demonstrations: int
    results: tuple[Result, ...]
    """One result per seed."""


@dataclass(frozen=True)
class TableEntry(Entry):
    """Success rates by checkpoint."""

    best: Estimate
    """Rate of each training's best checkpoint, as the paper reports it; this is optimistic."""
    last: Estimate
    """Rate of the last checkpoint."""
    last_five: Estimate
    """Mean rate of the last five checkpoints."""
    paper: float
    """The paper's rate in [0, 1]; nan if it prints none."""

    @property
    def episodes(self) -> int:
        """Number of episodes in the last five checkpoints of all seeds."""
        return sum(point.episodes for result in self.results for point in result.checkpoints[-LAST_CHECKPOINTS:])

    @property
    def has_one_checkpoint(self) -> bool:
        """Whether every training was evaluated once, so that all its rates are equal."""
        return all(len(result.checkpoints) == 1 for result in self.results)

    @property
    def difference(self) -> float:
        """Mean of `best` minus the paper's rate."""
        return self.best.mean - self.paper


@dataclass(frozen=True)
class PlacementEntry(Entry):
    """Success rates by camera."""

    rates: dict[str, Estimate]
    """Success rate with each camera, by its name; results that are older than a camera lack it."""


@dataclass(frozen=True)
class MethodPair:
    """Two methods on one task and number of demonstrations, which the paper puts in an order."""

    better: TableEntry
    """The method with the higher rate in the paper."""
    worse: TableEntry
    """The method with the lower rate in the paper."""
    probability: float
    """Probability that `better` has the higher rate here too, `order_probability`; nan without a common seed."""

    @property
    def measured_difference(self) -> float:
        """Measured rate of `better` minus that of `worse`, best checkpoints; negative where the order is reversed."""
        return self.better.best.mean - self.worse.best.mean

    @property
    def paper_difference(self) -> float:
        """The paper's rate of `better` minus that of `worse`."""
        return self.better.paper - self.worse.paper


def table_entries(experiment: Experiment, scale: str, folder: Path) -> list[TableEntry]:
    """Return the entries of an experiment at a scale, sorted by task, number of demonstrations and row."""
    paper = paper_values(experiment.name)
    return [_entry(*key, results, paper) for key, results in _grouped(experiment, scale, folder).items()]


def placement_entries(experiment: Experiment, scale: str, folder: Path) -> list[PlacementEntry]:
    """Return the entries of an experiment with several cameras; arguments and order as in `table_entries`."""
    return [
        PlacementEntry(*key, results, _by_camera(results))
        for key, results in _grouped(experiment, scale, folder).items()
    ]


def _by_camera(results: Sequence[Result]) -> dict[str, Estimate]:
    """Return the rate with each camera, over the seeds that have it."""
    points: dict[str, list[list[Checkpoint]]] = {}
    for result in results:
        for point in result.checkpoints:
            points.setdefault(point.camera, []).append([point])
    return {name: _pooled(seeds) for name, seeds in points.items()}


def _grouped(experiment: Experiment, scale: str, folder: Path) -> dict[tuple[MethodRow, str, int], tuple[Result, ...]]:
    """Return the results of each row, task and number of demonstrations."""
    groups: dict[tuple[str, int, str], list[Result]] = {}
    rows = {row.name: row for row in experiment.rows}
    for path in sorted((folder / experiment.name / scale).glob("*/*/*/*.csv")):
        task, row, demonstrations = path.parts[-4:-1]
        if row in rows and task in experiment.tasks:
            groups.setdefault((task, int(demonstrations), row), []).append(read_result(path))
    row_order = {row: index for index, row in enumerate(rows)}
    task_order = {task: index for index, task in enumerate(experiment.tasks)}
    ordered = sorted(groups, key=lambda key: (task_order[key[0]], key[1], row_order[key[2]]))
    return {(rows[row], task, count): tuple(groups[task, count, row]) for task, count, row in ordered}


def order_probability(better: Sequence[Result], worse: Sequence[Result]) -> float:
    """Return the probability that one method's success rate is higher than another's, after the last training step.

    It is the share of bootstrap samples in which it is higher; a tie counts half. A sample draws seeds with
    replacement, and for each seed scenes with replacement, the same ones for both methods.

    Args:
        better: results of the one method, one per seed; seeds that the other method lacks are ignored.
        worse: results of the other method.
    """
    last = [{result.origin.seed: result.checkpoints[-1].outcomes for result in results} for results in (better, worse)]
    pairs = [(outcomes, last[1].get(seed, "")) for seed, outcomes in last[0].items()]
    pairs = [pair for pair in pairs if pair[0] and len(pair[0]) == len(pair[1])]
    if not pairs:
        return math.nan
    rng = np.random.default_rng(0)
    scenes, shares = np.array([len(pair[0]) for pair in pairs]), np.array([_shares(*pair) for pair in pairs])
    drawn = rng.integers(len(pairs), size=(RESAMPLES, len(pairs)))
    won, lost, _ = np.moveaxis(rng.multinomial(scenes[drawn], shares[drawn]), -1, 0)
    difference = ((won - lost) / scenes[drawn]).sum(axis=1)
    return float((difference > 0).mean() + (difference == 0).mean() / 2)


def _shares(better: str, worse: str) -> tuple[float, float, float]:
    """Return the fractions of scenes in which the one method alone succeeds, the other alone, and neither or both."""
    won = sum(pair == ("1", "0") for pair in zip(better, worse, strict=True)) / len(better)
    lost = sum(pair == ("0", "1") for pair in zip(better, worse, strict=True)) / len(better)
    return won, lost, 1 - won - lost


def method_pairs(entries: Sequence[TableEntry]) -> list[MethodPair]:
    """Return all pairs of entries of one task and number of demonstrations whose rates differ in the paper."""
    pairs = []
    for first, second in combinations(entries, 2):
        is_comparable = (first.task, first.demonstrations) == (second.task, second.demonstrations)
        if is_comparable and first.paper != second.paper and not math.isnan(first.paper + second.paper):
            better, worse = (first, second) if first.paper > second.paper else (second, first)
            pairs.append(MethodPair(better, worse, order_probability(better.results, worse.results)))
    return pairs


def paper_values(experiment: str) -> dict[tuple[str, int, str], float]:
    """Return (task, demonstrations, row name) -> the paper's success rate in [0, 1]; empty for figures."""
    file = resources.files("symview_eval.experiments") / "paper" / f"{experiment}.csv"
    if not file.is_file():
        return {}
    return {
        (line["task"], int(line["demonstrations"]), line["method"]): float(line["success_percent"]) / 100
        for line in csv.DictReader(file.read_text().splitlines())
    }


def _entry(
    row: MethodRow,
    task: str,
    demonstrations: int,
    results: tuple[Result, ...],
    paper: dict[tuple[str, int, str], float],
) -> TableEntry:
    return TableEntry(
        row,
        task,
        demonstrations,
        results,
        _pooled([[max(result.checkpoints, key=lambda point: point.rate)] for result in results]),
        _pooled([result.checkpoints[-1:] for result in results]),
        _pooled([result.checkpoints[-LAST_CHECKPOINTS:] for result in results]),
        paper.get((task, demonstrations, row.name), math.nan),
    )


def _pooled(seeds: Sequence[Sequence[Checkpoint]]) -> Estimate:
    """Return the mean over seeds of the success rate of each seed's checkpoints.

    The interval covers two intervals: Student's t over seeds, for the variance between trainings, and Wilson's over
    episodes, which stays positive where all seeds have the same rate.
    """
    counts = [(sum(point.successes for point in points), sum(point.episodes for point in points)) for points in seeds]
    rates = [successes / episodes for successes, episodes in counts]
    low, high = SuccessRate(*map(sum, zip(*counts, strict=True))).interval
    mean = statistics.fmean(rates)
    if len(rates) > 1:
        half = float(stats.t.ppf(0.975, len(rates) - 1)) * statistics.stdev(rates) / math.sqrt(len(rates))
        low, high = min(low, max(0.0, mean - half)), max(high, min(1.0, mean + half))
    return Estimate(mean, low, high)


def scales_with_results(experiment: Experiment, folder: Path) -> list[str]:
    """Return the scales that have results, largest first."""
    return [scale for scale in SCALES if any((folder / experiment.name / scale).glob("*/*/*/*.csv"))]


def is_current(entry: Entry, experiment: Experiment, scale: str) -> bool:
    """Whether all of an entry's results have the experiment's present configuration."""
    seeds = [result.origin.seed for result in entry.results]
    cells = select(experiment, SCALES[scale], [entry.task], [entry.row.name], [entry.demonstrations], seeds)
    hashes = {cell.configuration_hash for cell in cells}
    return all(result.origin.configuration in hashes for result in entry.results)
