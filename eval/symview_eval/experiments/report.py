"""Report of all results: tables and plots with the paper's values, as HTML, Markdown and PNG."""

from __future__ import annotations

import io
import logging
import math
from dataclasses import dataclass
from pathlib import Path

import jinja2

from lerobot_symview.runtime.cli import CommandError
from symview_eval.contact_sheet import data_uri
from symview_eval.experiments.scale import SCALES, Scale
from symview_eval.experiments.summary import (
    Entry,
    MethodPair,
    PlacementEntry,
    TableEntry,
    is_current,
    method_pairs,
    placement_entries,
    scales_with_results,
    table_entries,
)
from symview_eval.experiments.tables import EXPERIMENTS, Experiment

logger = logging.getLogger(__name__)

CONFIDENT = 0.95


@dataclass(frozen=True)
class ReportConfig:
    """Rebuild the report's tables and plots from the raw results."""

    results_dir: Path = Path("results")
    """Folder of the raw results."""
    output_dir: Path = Path("outputs/report")
    """Folder for `report.html`, `report.md` and one PNG file per table or figure and scale."""


@dataclass(frozen=True)
class Section:
    """Results of a table or figure at one scale."""

    experiment: Experiment
    scale: Scale
    entries: list[TableEntry]
    placements: list[PlacementEntry]
    """In place of `entries`, for an experiment with several cameras."""
    stale_entries: list[Entry]
    """Entries with results of another configuration than the experiment's present one."""
    pairs: list[MethodPair]
    plot_png: bytes
    """The plot as a PNG file."""

    @property
    def name(self) -> str:
        """Name of the plot's file without its suffix."""
        return f"{self.experiment.name}_{self.scale.name}"

    @property
    def has_one_checkpoint(self) -> bool:
        """Whether best, last and mean of the last five are the same rate everywhere."""
        return all(entry.has_one_checkpoint for entry in self.entries)

    @property
    def holding(self) -> list[MethodPair]:
        """Pairs whose order in the paper holds here with a probability of 95 % or more."""
        return [pair for pair in self.pairs if pair.probability >= CONFIDENT]

    @property
    def contradicted(self) -> list[MethodPair]:
        """Pairs whose order in the paper holds here with a probability of 5 % or less."""
        return [pair for pair in self.pairs if pair.probability <= 1 - CONFIDENT]

    @property
    def machines(self) -> list[str]:
        """Machines and package versions of the results."""
        entries: list[Entry] = [*self.entries, *self.placements]
        origins = (result.origin for entry in entries for result in entry.results)
        return sorted({f"{origin.machine} (version {origin.version})" for origin in origins})


def report(config: ReportConfig) -> Path:
    """Write the report and return the path of its HTML page.

    Raises:
        CommandError: if there are no results.
    """
    sections = [
        _section(experiment, scale, config.results_dir)
        for experiment in EXPERIMENTS.values()
        for scale in scales_with_results(experiment, config.results_dir)
    ]
    if not sections:
        raise CommandError(
            f"no results in {config.results_dir}: run symview-experiment table1 first, or check --results_dir"
        )
    config.output_dir.mkdir(parents=True, exist_ok=True)
    for section in sections:
        (config.output_dir / f"{section.name}.png").write_bytes(section.plot_png)
    templates = jinja2.Environment(
        loader=jinja2.PackageLoader("symview_eval"),
        autoescape=jinja2.select_autoescape(["html"]),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters |= {"percent": percent, "points": points, "image": lambda data: data_uri("image/png", data)}
    for name in ("report.md", "report.html"):
        (config.output_dir / name).write_text(templates.get_template(f"experiments_{name}").render(sections=sections))
    page = config.output_dir / "report.html"
    logger.info("report: %s", page.resolve())
    return page


def percent(rate: float) -> str:
    """Format a rate in [0, 1] as percent; an empty string for nan."""
    return "" if math.isnan(rate) else f"{100 * rate:.1f}"


def points(difference: float) -> str:
    """Format a difference of rates as signed percentage points; an empty string for nan."""
    return "" if math.isnan(difference) else f"{100 * difference:+.1f}"


def _section(experiment: Experiment, scale: str, folder: Path) -> Section:
    from symview_eval.experiments.plots import plot, plot_placements  # imports matplotlib, which takes long

    entries = [] if experiment.placements else table_entries(experiment, scale, folder)
    placements = placement_entries(experiment, scale, folder) if experiment.placements else []
    stale: list[Entry] = [*entries, *placements]
    stale = [entry for entry in stale if not is_current(entry, experiment, scale)]
    figure = plot_placements(experiment, scale, placements) if placements else plot(experiment, scale, entries)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return Section(experiment, SCALES[scale], entries, placements, stale, method_pairs(entries), stream.getvalue())
