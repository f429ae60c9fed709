"""Plots of results."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from symview_eval.experiments.results import Result
from symview_eval.experiments.summary import PlacementEntry, TableEntry
from symview_eval.experiments.tables import Experiment

MEASURED_COLOR, PAPER_COLOR = "#1f5fa8", "#c2571a"


def plot(experiment: Experiment, scale: str, entries: Sequence[TableEntry]) -> Figure:
    """Return an experiment's plot: learning curves (SACfD), success by elevation (figure 7) or success by method."""
    if experiment.algorithm == "sacfd":
        figure = _curves(entries)
    else:
        figure = _elevations(entries) if experiment.name == "figure7" else _rows(entries)
    figure.suptitle(f"{experiment.title} ({experiment.name}), scale {scale}", fontsize=10)
    return figure


def plot_placements(experiment: Experiment, scale: str, entries: Sequence[PlacementEntry]) -> Figure:
    """Return the success rate of every method with every camera as a coloured table, one panel for each task."""
    names = [name for name, _ in experiment.placements]
    tasks = list(dict.fromkeys((entry.task, entry.demonstrations) for entry in entries))
    heights = [sum((entry.task, entry.demonstrations) == task for entry in entries) for task in tasks]
    figure = Figure(figsize=(13, 1.6 + 0.32 * sum(heights) + 1.4 * len(tasks)), layout="constrained")
    axes = figure.subplots(len(tasks), 1, squeeze=False, height_ratios=heights).flatten()
    for (task, demonstrations), axis in zip(tasks, axes, strict=True):
        rows = [entry for entry in entries if (entry.task, entry.demonstrations) == (task, demonstrations)]
        rates = [
            [100 * entry.rates[name].mean if name in entry.rates else math.nan for name in names] for entry in rows
        ]
        axis.imshow(rates, cmap="viridis", vmin=0, vmax=100, aspect="auto")
        for y, line in enumerate(rates):
            for x, rate in enumerate(line):
                shown = "" if math.isnan(rate) else f"{rate:.0f}"
                axis.text(x, y, shown, ha="center", va="center", fontsize=8, color="white" if rate < 60 else "black")
        axis.set_xticks(range(len(names)), names, rotation=35, ha="right", fontsize=8)
        axis.set_yticks(range(len(rows)), [entry.row.label for entry in rows], fontsize=8)
        axis.set_title(f"{task.replace('_', ' ')}, {demonstrations} demonstrations: success, %", fontsize=10)
    figure.suptitle(f"{experiment.title} ({experiment.name}), scale {scale}", fontsize=10)
    return figure


def _panels(entries: Sequence[TableEntry], height: float) -> tuple[Figure, dict[tuple[str, int], Any]]:
    """Return a figure, and its axes by task and number of demonstrations."""
    names = list(dict.fromkeys((entry.task, entry.demonstrations) for entry in entries))
    columns = min(3, len(names))
    rows = math.ceil(len(names) / columns)
    figure = Figure(figsize=(4.6 * columns, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).flatten()
    for unused in axes[len(names) :]:
        unused.set_axis_off()
    for (task, demonstrations), axis in zip(names, axes, strict=False):
        axis.set_title(f"{task.replace('_', ' ')}, {demonstrations} demonstrations", fontsize=10)
        axis.grid(alpha=0.3)
    return figure, dict(zip(names, axes, strict=False))


def _rows(entries: Sequence[TableEntry]) -> Figure:
    figure, panels = _panels(entries, 2.6)
    for group, axis in panels.items():
        rows = [entry for entry in entries if (entry.task, entry.demonstrations) == group][::-1]
        for y, entry in enumerate(rows):
            low, high = (100 * end for end in (entry.last_five.low, entry.last_five.high))
            axis.plot([low, high], [y, y], color=MEASURED_COLOR, alpha=0.35, linewidth=6, solid_capstyle="butt")
            axis.plot(100 * entry.last_five.mean, y, "|", color=MEASURED_COLOR, markersize=12, markeredgewidth=2)
            axis.plot(100 * entry.best.mean, y, "o", color=MEASURED_COLOR)
            axis.plot(100 * entry.paper, y, "D", color=PAPER_COLOR, fillstyle="none")
        axis.set_yticks(range(len(rows)), [entry.row.label for entry in rows], fontsize=9)
        axis.set_ylim(-0.6, len(rows) - 0.4)
        axis.set_xlim(-2, 102)
        axis.set_xlabel("success, %", fontsize=9)
    _legend(
        figure,
        [
            {"marker": "o", "color": MEASURED_COLOR, "label": "best checkpoint"},
            {"marker": "|", "color": MEASURED_COLOR, "markersize": 12, "label": "last five, mean and 95 % interval"},
            {"marker": "D", "color": PAPER_COLOR, "fillstyle": "none", "label": "paper, best checkpoint"},
        ],
    )
    return figure


def _elevations(entries: Sequence[TableEntry]) -> Figure:
    figure, panels = _panels(entries, 3.2)
    for group, axis in panels.items():
        series: dict[str, list[TableEntry]] = {}
        for entry in entries:
            if (entry.task, entry.demonstrations) == group:
                modality = "RGB" if entry.row.policy.get("modality") == "rgb" or "persp" in entry.row.name else "RGBD"
                series.setdefault(f"{entry.row.label.split(',')[0]} ({modality})", []).append(entry)
        for label, members in series.items():
            is_oracle = "Oracle" in label
            elevations = [90.0 if is_oracle else entry.row.camera.elevation_deg for entry in members]
            estimates = [entry.last_five for entry in members]
            rates = [100 * estimate.mean for estimate in estimates]
            below = [100 * (estimate.mean - estimate.low) for estimate in estimates]
            above = [100 * (estimate.high - estimate.mean) for estimate in estimates]
            marker = "*" if is_oracle else "o"
            axis.errorbar(elevations, rates, yerr=[below, above], marker=marker, capsize=2, label=label)
        axis.set_xlabel("camera elevation, degrees", fontsize=9)
        axis.set_ylabel("success, %, mean of the last five checkpoints", fontsize=9)
        axis.set_ylim(0, 100)
        axis.legend(fontsize=7)
    return figure


def _curves(entries: Sequence[TableEntry]) -> Figure:
    figure, panels = _panels(entries, 3.0)
    for entry in entries:
        axis = panels[entry.task, entry.demonstrations]
        steps, means, spreads = _mean_curve(entry.results)
        (line,) = axis.plot(steps, means, marker=".", label=entry.row.label)
        lower = [mean - spread for mean, spread in zip(means, spreads, strict=True)]
        upper = [mean + spread for mean, spread in zip(means, spreads, strict=True)]
        axis.fill_between(steps, lower, upper, color=line.get_color(), alpha=0.2)
        axis.set_xlabel("joint steps", fontsize=9)
        axis.set_ylabel("discounted return", fontsize=9)
        axis.set_ylim(0, 1)
        axis.legend(fontsize=7)
    return figure


def _mean_curve(results: Sequence[Result]) -> tuple[list[int], list[float], list[float]]:
    """Return steps, and mean and standard deviation of the return over seeds, for the steps that all seeds reached."""
    columns = list(zip(*([point.mean_return for point in result.checkpoints] for result in results), strict=False))
    steps = [point.step for point in results[0].checkpoints[: len(columns)]]
    return steps, [statistics.fmean(column) for column in columns], [statistics.pstdev(column) for column in columns]


def _legend(figure: Figure, styles: list[dict[str, Any]]) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], linestyle="", **style) for style in styles]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9)
