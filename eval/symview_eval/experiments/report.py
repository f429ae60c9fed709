"""Tables and plots of the results there are, beside the paper's values."""

from __future__ import annotations

import io
import logging
import math
from dataclasses import dataclass
from pathlib import Path

import jinja2

from lerobot_symview.runtime.cli import CommandError
from symview_eval.contact_sheet import data_uri
from symview_eval.experiments.grid import EXPERIMENTS, Experiment
from symview_eval.experiments.scale import SCALES, Scale
from symview_eval.experiments.summary import (
    Entry,
    Ordering,
    entries,
    is_current,
    measured_scales,
    orderings,
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ReportConfig:
    """Rebuild tables and plots from raw results."""

    results_dir: Path = Path("results")
    """Where they are."""
    output_dir: Path = Path("outputs/report")
    """Where `report.html`, `report.md` and a PNG file for every table and figure go."""


@dataclass(frozen=True)
class Section:
    """A table or figure at one scale."""

    experiment: Experiment
    scale: Scale
    entries: list[Entry]
    stale: list[Entry]
    """Of these, the ones whose configuration is no longer the experiment's."""
    orderings: list[Ordering]
    picture: bytes

    @property
    def name(self) -> str:
        """Of its picture."""
        return f"{self.experiment.name}_{self.scale.name}"

    @property
    def reversed(self) -> list[Ordering]:
        """Pairs of rows that are the other way round here, or level, largest difference in the paper first."""
        return sorted((pair for pair in self.orderings if pair.found <= 0), key=lambda pair: -pair.stated)

    @property
    def machines(self) -> list[str]:
        """What the results were computed on."""
        origins = (result.origin for entry in self.entries for result in entry.results)
        return sorted({f"{origin.machine} (version {origin.version})" for origin in origins})


def report(config: ReportConfig) -> Path:
    """Write the report and return its page.

    Raises:
        CommandError: if there are no results.
    """
    sections = [
        _section(experiment, scale, config.results_dir)
        for experiment in EXPERIMENTS.values()
        for scale in measured_scales(experiment, config.results_dir)
    ]
    if not sections:
        raise CommandError(
            f"there are no results in {config.results_dir}: run symview-experiment table1 first, or see --results_dir"
        )
    config.output_dir.mkdir(parents=True, exist_ok=True)
    for section in sections:
        (config.output_dir / f"{section.name}.png").write_bytes(section.picture)
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
    """Return a rate in percent, nothing if there is none."""
    return "" if math.isnan(rate) else f"{100 * rate:.1f}"


def points(difference: float) -> str:
    """Return a difference of rates in percentage points with its sign, nothing if there is none."""
    return "" if math.isnan(difference) else f"{100 * difference:+.1f}"


def _section(experiment: Experiment, scale: str, folder: Path) -> Section:
    from symview_eval.experiments.plots import plot  # matplotlib, which other commands do not wait for

    found = entries(experiment, scale, folder)
    stale = [entry for entry in found if not is_current(entry, experiment, scale)]
    stream = io.BytesIO()
    plot(experiment, scale, found).savefig(stream, format="png", dpi=110)
    return Section(experiment, SCALES[scale], found, stale, orderings(found), stream.getvalue())
