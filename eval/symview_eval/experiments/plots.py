"""Plots of results."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from symview_eval.experiments.results import Result
from symview_eval.experiments.summary import Entry, PlacementEntry, TableEntry
from symview_eval.experiments.tables import Experiment

MEASURED_COLOR, PAPER_COLOR = "#1f5fa8", "#c2571a"
PANEL_WIDTH, LABEL_WIDTH = 2.8, 0.068  # inches: of a panel without its method names, and of one of their letters
LEAST_WIDTH = 7.2  # of a figure, for its title and legend
ELEVATION_SHIFT = 0.6  # degrees between the methods of one elevation, so that their intervals do not cover each other


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
        axis.set_yticks(range(len(rows)), [f"{entry.row.label}, {_seeds(entry)}" for entry in rows], fontsize=8)
        episodes = rows[0].results[0].checkpoints[0].episodes
        about = f"success, %, mean over seeds of {episodes} episodes"
        axis.set_title(f"{task.replace('_', ' ')}, {demonstrations} demonstrations: {about}", fontsize=10)
    figure.suptitle(f"{experiment.title} ({experiment.name}), scale {scale}", fontsize=10)
    return figure


def _panels(
    entries: Sequence[TableEntry], height: float, labels: Sequence[str] = ()
) -> tuple[Figure, dict[tuple[str, int], Any]]:
    """Return a figure, and its axes by task and number of demonstrations, wide enough for `labels` beside them."""
    names = list(dict.fromkeys((entry.task, entry.demonstrations) for entry in entries))
    columns = min(3, len(names))
    rows = math.ceil(len(names) / columns)
    panel = max(4.6, PANEL_WIDTH + LABEL_WIDTH * max(map(len, labels), default=0))
    figure = Figure(figsize=(max(panel * columns, LEAST_WIDTH), height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).flatten()
    for unused in axes[len(names) :]:
        unused.set_axis_off()
    for (task, demonstrations), axis in zip(names, axes, strict=False):
        axis.set_title(f"{task.replace('_', ' ')}, {demonstrations} demonstrations", fontsize=10)
        axis.grid(alpha=0.3)
    return figure, dict(zip(names, axes, strict=False))


def _rows(entries: Sequence[TableEntry]) -> Figure:
    figure, panels = _panels(entries, 2.6, [entry.row.label for entry in entries])
    is_one = all(entry.has_one_checkpoint for entry in entries)
    for group, axis in panels.items():
        rows = [entry for entry in entries if (entry.task, entry.demonstrations) == group][::-1]
        for y, entry in enumerate(rows):
            low, high = (100 * end for end in (entry.last_five.low, entry.last_five.high))
            axis.plot([low, high], [y, y], color=MEASURED_COLOR, alpha=0.35, linewidth=6, solid_capstyle="butt")
            axis.plot(100 * entry.last_five.mean, y, "|", color=MEASURED_COLOR, markersize=12, markeredgewidth=2)
            if not is_one:
                axis.plot(100 * entry.best.mean, y, "o", color=MEASURED_COLOR)
            axis.plot(100 * entry.paper, y, "D", color=PAPER_COLOR, fillstyle="none")
        axis.set_yticks(range(len(rows)), [entry.row.label for entry in rows], fontsize=9)
        axis.set_ylim(-0.6, len(rows) - 0.4)
        axis.set_xlim(-2, 102)
        axis.set_xlabel("success, %", fontsize=9)
    which = "" if is_one else "last five checkpoints, "
    styles: list[dict[str, Any]] = [
        {"marker": "|", "color": MEASURED_COLOR, "markersize": 12, "label": f"{which}mean and 95 % interval"},
        {"marker": "o", "color": MEASURED_COLOR, "label": "best checkpoint"},
        {"marker": "D", "color": PAPER_COLOR, "fillstyle": "none", "label": "paper, best checkpoint"},
    ]
    is_in_paper = any(not math.isnan(entry.paper) for entry in entries)
    shown = [True, not is_one, is_in_paper]
    _legend(figure, [style for style, is_shown in zip(styles, shown, strict=True) if is_shown])
    return figure


def _elevations(entries: Sequence[TableEntry]) -> Figure:
    figure, panels = _panels(entries, 3.2)
    names = list(dict.fromkeys(_series(entry) for entry in entries))
    for group, axis in panels.items():
        for index, name in enumerate(names):
            members = [
                entry for entry in entries if (entry.task, entry.demonstrations) == group and _series(entry) == name
            ]
            is_oracle = "Oracle" in name
            shift = ELEVATION_SHIFT * (index - (len(names) - 1) / 2)
            elevations = [(90.0 if is_oracle else entry.row.camera.elevation_deg) + shift for entry in members]
            estimates = [entry.last_five for entry in members]
            rates = [100 * estimate.mean for estimate in estimates]
            below = [100 * (estimate.mean - estimate.low) for estimate in estimates]
            above = [100 * (estimate.high - estimate.mean) for estimate in estimates]
            marker = "*" if is_oracle else "o"
            axis.errorbar(elevations, rates, [below, above], marker=marker, color=f"C{index}", capsize=2)
        axis.set_xlabel("camera elevation, degrees", fontsize=9)
        axis.set_xlim(10, 95)
        axis.set_xticks(range(15, 91, 15))
        axis.set_ylabel("success, %, and 95 % interval", fontsize=9)
        axis.set_ylim(0, 102)
    _legend(
        figure,
        [
            {"marker": "*" if "Oracle" in name else "o", "color": f"C{index}", "label": name}
            for index, name in enumerate(names)
        ],
    )
    return figure


def _series(entry: TableEntry) -> str:
    """Return the label of a row of figure 7 without its elevation."""
    return entry.row.label.split(",")[0]


def _curves(entries: Sequence[TableEntry]) -> Figure:
    figure, panels = _panels(entries, 3.0)
    colors = {label: f"C{index}" for index, label in enumerate(dict.fromkeys(entry.row.label for entry in entries))}
    for entry in entries:
        axis, color = panels[entry.task, entry.demonstrations], colors[entry.row.label]
        steps, means, spreads = _mean_curve(entry.results)
        axis.plot(steps, means, marker=".", color=color, label=_seeds(entry))
        lower = [mean - spread for mean, spread in zip(means, spreads, strict=True)]
        upper = [mean + spread for mean, spread in zip(means, spreads, strict=True)]
        axis.fill_between(steps, lower, upper, color=color, alpha=0.2)
        axis.set_xlabel("joint steps, one update each", fontsize=9)
        axis.set_ylabel("discounted return", fontsize=9)
        axis.set_xlim(left=0)
        axis.set_ylim(0, 1)
        axis.legend(fontsize=7)
    band: dict[str, Any] = {
        "marker": "s",
        "markersize": 10,
        "color": "gray",
        "alpha": 0.3,
        "label": "standard deviation of the seeds",
    }
    styles: list[dict[str, Any]] = [{"marker": ".", "color": color, "label": label} for label, color in colors.items()]
    _legend(figure, [*styles, band] if any(len(entry.results) > 1 for entry in entries) else styles)
    return figure


def _seeds(entry: Entry) -> str:
    """Return how many seeds an entry has, in words."""
    return f"{len(entry.results)} seed{'s' if len(entry.results) > 1 else ''}"


def _mean_curve(results: Sequence[Result]) -> tuple[list[int], list[float], list[float]]:
    """Return steps, and mean and standard deviation of the return over seeds, for the steps that all seeds reached."""
    columns = list(zip(*([point.mean_return for point in result.checkpoints] for result in results), strict=False))
    steps = [point.step for point in results[0].checkpoints[: len(columns)]]
    return steps, [statistics.fmean(column) for column in columns], [statistics.pstdev(column) for column in columns]


def _legend(figure: Figure, styles: list[dict[str, Any]]) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], linestyle="", **style) for style in styles]
    columns = min(len(handles), 3 if figure.get_figwidth() < 2 * LEAST_WIDTH - 1 else 6)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=9)
