"""Raw results of cells: a CSV file each, which says what it came from."""

from __future__ import annotations

import csv
import io
import logging
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from symview_eval.experiments.grid import Cell

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Checkpoint:
    """How well a policy did at some point of its training."""

    step: int
    successes: int
    episodes: int
    mean_return: float
    """Discounted."""
    loss: float
    """Mean since the checkpoint before; nan where it is not known."""

    @property
    def rate(self) -> float:
        """Successes per episode."""
        return self.successes / self.episodes


@dataclass(frozen=True)
class Times:
    """Where a cell's time went; nan where that was not measured."""

    preparation_s: float = math.nan
    """Reading demonstrations, building the policy, starting simulators."""
    training_s: float = math.nan
    """Training."""
    waiting_s: float = math.nan
    """After it, until the last evaluation was done."""
    evaluation_s: float = math.nan
    """Evaluations, most of it beside the training."""
    cpu_s: float = math.nan
    """Processor time of all of it, simulators included."""


@dataclass(frozen=True)
class Origin:
    """Where a result comes from."""

    configuration: str
    """Hash of everything that determines it."""
    seed: int
    """Of scenes, demonstrations and training."""
    version: str
    """Of this package."""
    machine: str
    """What it ran on."""
    seconds: float
    """From the cell's beginning to its end."""
    device: str
    """Where the networks were."""


@dataclass(frozen=True)
class Result:
    """What came of a cell."""

    origin: Origin
    times: Times
    checkpoints: list[Checkpoint]


def write_result(path: Path, result: Result) -> None:
    """Write a result, whole or not at all."""
    stream = io.StringIO()
    for name, value in (asdict(result.origin) | asdict(result.times)).items():
        stream.write(f"# {name}: {_shown(value)}\n")
    writer = csv.DictWriter(stream, [entry.name for entry in fields(Checkpoint)], lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _shown(value) for name, value in asdict(point).items()} for point in result.checkpoints)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(stream.getvalue())
    part.rename(path)


def read_result(path: Path) -> Result:
    """Return what `write_result` wrote.

    Raises:
        ValueError: if the file is something else.
    """
    lines = path.read_text().splitlines()
    stated = dict(line[2:].split(": ", 1) for line in lines if line.startswith("# "))
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    try:
        checkpoints = [Checkpoint(**_fields(Checkpoint, row)) for row in rows]
        return Result(Origin(**_fields(Origin, stated)), Times(**_fields(Times, stated)), checkpoints)
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path} is not a result of symview-experiment: {error!r}") from None


def unfinished(cells: Iterable[Cell], folder: Path, configurations: dict[str, Path]) -> Iterator[Cell]:
    """Yield the cells that have no result yet; what another table has the result of is copied from there.

    Args:
        cells: to look for.
        folder: of all results.
        configurations: hash -> file of every result there is.
    """
    for cell in cells:
        path, known = folder / cell.path, configurations.get(cell.configuration_hash)
        if path.exists() and read_result(path).origin.configuration == cell.configuration_hash:
            continue
        if known is None:
            if path.exists():
                logger.info("%s is of another configuration and is run again", path)
            yield cell
        else:
            logger.info("%s is the run of %s", path, known)
            write_result(path, read_result(known))


def finished(folder: Path, scale: str) -> dict[str, Path]:
    """Return configuration hash -> file of the results of a scale."""
    return {read_result(path).origin.configuration: path for path in sorted(folder.glob(f"*/{scale}/*/*/*/*.csv"))}


def _shown(value: float | str) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _fields(kind: Any, texts: dict[str, str]) -> dict[str, Any]:
    """Return the values of a dataclass's fields, each of the type that it states."""
    types = {"int": int, "float": float, "str": str}
    return {entry.name: types[str(entry.type)](texts[entry.name]) for entry in fields(kind)}
