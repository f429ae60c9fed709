"""Write the measured success rates into the tables of README.md, docs/results.md and docs/cameras.md.

A table stands between `<!-- results: table1, 10 -->`, which names an experiment and a number of demonstrations (or
several experiments: `table1 table2, 10`), and `<!-- end of results -->`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

from symview_eval.experiments.summary import TableEntry, placement_entries, table_entries
from symview_eval.experiments.tables import EXPERIMENTS, Experiment

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", ROOT / "docs" / "results.md", ROOT / "docs" / "cameras.md")
SCALE = "laptop"
TABLE = re.compile(r"(<!-- results: ([\w ]+), (\d+) -->\n).*?(<!-- end of results -->)", re.DOTALL)


def updated(page: str, results: Path) -> str:
    """Return a page's text with the tables of the results in a folder."""
    return TABLE.sub(lambda match: match[1] + table(match[2].split(), int(match[3]), results) + match[4], page)


def table(experiments: Sequence[str], demonstrations: int, results: Path) -> str:
    """Return a Markdown table with the methods as rows and the tasks as columns; of cameras, `placement_table`."""
    rows: dict[str, dict[str, str]] = {}
    seeds: dict[str, set[int]] = {}
    for experiment in (EXPERIMENTS[name] for name in experiments):
        if experiment.placements:
            return placement_table(experiment, results)
        for entry in table_entries(experiment, SCALE, results):
            if entry.demonstrations == demonstrations:
                rows.setdefault(entry.row.label, {})[entry.task.replace("_", " ")] = cell(entry)
                seeds.setdefault(entry.row.label, set()).add(len(entry.results))
    for label, row in rows.items():
        row["seeds"] = " to ".join(str(count) for count in sorted({min(seeds[label]), max(seeds[label])}))
    return markdown(rows)


def placement_table(experiment: Experiment, results: Path) -> str:
    """Return a Markdown table with the cameras as rows, and the methods and tasks, with their seeds, as columns."""
    rows: dict[str, dict[str, str]] = {name: {} for name, _ in experiment.placements}
    for entry in placement_entries(experiment, SCALE, results):
        count = len(entry.results)
        label = f"{entry.row.label}, {entry.task.replace('_', ' ')} ({count} seed{'s' if count > 1 else ''})"
        for name, rate in entry.rates.items():
            rows[name][label] = f"{percent(rate.mean)}"
    return markdown({name: row for name, row in rows.items() if row})


def markdown(rows: dict[str, dict[str, str]]) -> str:
    """Return a Markdown table of rows by label and columns by name."""
    if not rows:
        return "\nNo run has finished yet.\n\n"
    columns = list(dict.fromkeys(column for row in rows.values() for column in row if column != "seeds"))
    columns += ["seeds"] if any("seeds" in row for row in rows.values()) else []
    lines = [f"| | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    lines += [f"| {label} | {' | '.join(row.get(column, '') for column in columns)} |" for label, row in rows.items()]
    return "\n" + "\n".join(lines) + "\n\n"


def cell(entry: TableEntry) -> str:
    """Return the rate after the last step, its interval and the paper's rate, in per cent: `83 [71, 91] (85)`."""
    last = entry.last
    paper = "" if math.isnan(entry.paper) else f" ({percent(entry.paper)})"
    return f"{percent(last.mean)} [{percent(last.low)}, {percent(last.high)}]{paper}"


def percent(rate: float) -> int:
    """Return a rate in [0, 1] as per cent; halves are rounded up."""
    return math.floor(100 * rate + 0.5 + 1e-9)


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(updated(page.read_text(), ROOT / "results"))
