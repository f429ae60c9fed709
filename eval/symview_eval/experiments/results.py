"""Raw results of cells: one CSV file per cell, with its configuration hash, version, machine and times in comments."""

from __future__ import annotations

import csv
import io
import logging
import math
from collections.abc import Iterable
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_symview.runtime.staging import part_of
from symview_eval.experiments.grid import Cell

if TYPE_CHECKING:
    from lerobot_policy_symview.rl.rollouts import Evaluation

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Checkpoint:
    """Evaluation of a policy at one step of its training."""

    step: int
    successes: int
    episodes: int
    mean_return: float
    """Mean discounted return of the episodes."""
    loss: float
    """Mean training loss since the previous checkpoint; nan where it is not recorded."""
    outcomes: str = ""
    """1 or 0 for each episode, success or failure, in the order of the scenes' seeds; empty where it is not recorded.

    The scenes of a seed and step are the same for all methods, so that methods are compared scene by scene.
    """
    camera: str = ""
    """The camera's placement, where an experiment evaluates with several cameras; they have the same scenes."""

    @property
    def rate(self) -> float:
        """Successes per episode."""
        return self.successes / self.episodes


def checkpoint(step: int, evaluation: Evaluation, loss: float = math.nan, camera: str = "") -> Checkpoint:
    """Return the checkpoint of an evaluation after `step` training steps."""
    outcomes = "".join(str(int(success)) for success in evaluation.success)
    successes, episodes = sum(evaluation.success), len(evaluation.success)
    return Checkpoint(step, successes, episodes, evaluation.mean_return, loss, outcomes, camera)


@dataclass(frozen=True)
class Times:
    """Seconds that the parts of a cell took; nan where not measured."""

    preparation_s: float = math.nan
    """Reading demonstrations, building the policy, starting simulators."""
    training_s: float = math.nan
    """Training steps."""
    waiting_s: float = math.nan
    """From the end of training to the end of the last evaluation."""
    evaluation_s: float = math.nan
    """Evaluations, most of them in parallel with the training."""
    cpu_s: float = math.nan
    """CPU time of the whole cell, simulators included."""

    @property
    def wall_clock_s(self) -> float:
        """Wall-clock time of all parts; evaluations during the training add nothing to it."""
        return self.preparation_s + self.training_s + self.waiting_s

    def __add__(self, other: Times) -> Times:
        """Return the sums of all times."""
        return Times(*(one + another for one, another in zip(astuple(self), astuple(other), strict=True)))


@dataclass(frozen=True)
class Origin:
    """Configuration, software and machine that a result was computed with."""

    configuration: str
    """`Cell.configuration_hash`."""
    seed: int
    """Seed of scenes, demonstrations and training."""
    version: str
    """Version of this package."""
    machine: str
    """Operating system, architecture, cores and GPU."""
    seconds: float
    """Wall-clock time of the cell."""
    device: str
    """PyTorch device of the networks."""


@dataclass(frozen=True)
class Result:
    """Results of a cell."""

    origin: Origin
    times: Times
    checkpoints: list[Checkpoint]


def write_result(path: Path, result: Result) -> None:
    """Write a result file atomically."""
    stream = io.StringIO()
    for name, value in (asdict(result.origin) | asdict(result.times)).items():
        stream.write(f"# {name}: {_text(value)}\n")
    writer = csv.DictWriter(stream, [column.name for column in fields(Checkpoint)], lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _text(value) for name, value in asdict(point).items()} for point in result.checkpoints)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = part_of(path)
    part.write_text(stream.getvalue())
    part.rename(path)


def read_result(path: Path) -> Result:
    """Read a result file.

    Raises:
        ValueError: if the file is not one that `write_result` wrote.
    """
    lines = path.read_text().splitlines()
    header = dict(line[2:].split(": ", 1) for line in lines if line.startswith("# "))
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    try:
        checkpoints = [Checkpoint(**_parsed(Checkpoint, row)) for row in rows]
        return Result(Origin(**_parsed(Origin, header)), Times(**_parsed(Times, header)), checkpoints)
    except (KeyError, ValueError) as error:
        raise ValueError(
            f"{path} is not a result of symview-experiment, delete it to run the cell again: {error!r}"
        ) from None


def finished_results(folder: Path, scale: str) -> dict[Path, Result]:
    """Return the results of a scale, by their files relative to `folder`."""
    return {path.relative_to(folder): read_result(path) for path in sorted(folder.glob(f"*/{scale}/*/*/*/*.csv"))}


def unfinished_cells(cells: Iterable[Cell], finished: dict[Path, Result]) -> list[Cell]:
    """Return the cells whose configuration has no result, in any table; `finished` is that of `finished_results`."""
    known = {result.origin.configuration for result in finished.values()}
    unfinished = [cell for cell in cells if cell.configuration_hash not in known]
    for cell in unfinished:
        if cell.path in finished:
            logger.info("%s has another configuration and is run again", cell.path)
    return unfinished


def copy_shared(cells: Iterable[Cell], folder: Path, finished: dict[Path, Result]) -> None:
    """Write the results of other tables for the cells that have the same configuration."""
    known = {result.origin.configuration: result for result in finished.values()}
    for cell in cells:
        own, shared = finished.get(cell.path), known.get(cell.configuration_hash)
        if shared is not None and (own is None or own.origin.configuration != cell.configuration_hash):
            write_result(folder / cell.path, shared)


def _text(value: float | str) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _parsed(dataclass_type: Any, texts: dict[str, str]) -> dict[str, Any]:
    """Return the values of a dataclass's fields, converted to the fields' types."""
    types = {"int": int, "float": float, "str": str}
    return {item.name: types[str(item.type)](texts[item.name]) for item in fields(dataclass_type)}
