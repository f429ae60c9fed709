"""Metrics of a training run: averages over a window of steps, CSV files, a progress bar, and Weights & Biases."""

from __future__ import annotations

import csv
import math
import statistics
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor
from tqdm import tqdm

from lerobot_policy_symview.rl.train_config import TrainRlConfig

STEP = "step"


@dataclass
class MetricsWindow:
    """Updates and finished episodes since the last row of `training.csv`."""

    updates: int = 0
    sums: dict[str, Any] = field(default_factory=dict)
    success: list[bool] = field(default_factory=list)
    discounted_return: list[float] = field(default_factory=list)
    lost: int = 0

    def add_update(self, metrics: dict[str, Tensor]) -> None:
        """Add the metrics of an update."""
        self.updates += 1
        for name, value in metrics.items():
            self.sums[name] = self.sums.get(name, 0.0) + value

    def averages(self, names: tuple[str, ...]) -> dict[str, float]:
        """Return the row of the log, `nan` for averages of nothing; reading the metrics waits for a GPU."""
        updates = {name: float(self.sums[name]) / self.updates if self.updates else math.nan for name in names}
        return {
            "episodes": len(self.success),
            "success": statistics.fmean(self.success) if self.success else math.nan,
            "return": statistics.fmean(self.discounted_return) if self.success else math.nan,
            "lost_episodes": self.lost,
            **updates,
        }

    def to_json(self) -> dict[str, Any]:
        """Return the fields for a checkpoint's JSON, from which Python restores floats bit-identically."""
        return vars(self) | {"sums": {name: float(value) for name, value in self.sums.items()}}


class MetricsTable:
    """A CSV file that gets one row at a time; rows after the step that a run resumes from are dropped.

    Args:
        path: the file.
        last_step: last step to keep.
    """

    def __init__(self, path: Path, last_step: int):
        self._path = path
        if path.exists():
            header, *rows = path.read_text().splitlines(keepends=True)
            path.write_text("".join([header, *(row for row in rows if int(row.split(",")[0]) <= last_step)]))

    def add(self, row: dict[str, float]) -> None:
        """Append a row; all rows have the same columns."""
        is_new = not self._path.exists()
        with self._path.open("a", newline="") as stream:
            writer = csv.DictWriter(stream, row, lineterminator="\n")
            if is_new:
                writer.writeheader()
            writer.writerow(row)


def read_table(path: Path) -> list[dict[str, float]]:
    """Return the rows of a table; the column `step` is an integer."""
    with path.open(newline="") as stream:
        return [
            {name: int(value) if name == STEP else float(value) for name, value in row.items()}
            for row in csv.DictReader(stream)
        ]


class MetricsLogger:
    """Writes a run's metrics to `training.csv` and `evaluation.csv`, the progress bar, and Weights & Biases.

    Args:
        config: the run's configuration.
        step: steps done before.
        run_id: the run's identifier at Weights & Biases; None for a new one.
        description: the configuration as Weights & Biases shows it.
    """

    def __init__(self, config: TrainRlConfig, step: int, run_id: str | None, description: dict[str, Any]):
        folder, wandb = config.output_dir, config.wandb
        folder.mkdir(parents=True, exist_ok=True)
        self._training = MetricsTable(folder / "training.csv", step)
        self._evaluation = MetricsTable(folder / "evaluation.csv", step)
        self._bar = tqdm(total=config.steps, initial=step, desc="training", unit="step", dynamic_ncols=True)
        self._postfix: dict[str, str] = {}
        self._wandb: Any = None
        if wandb.enable:
            import wandb as client

            self._wandb = client.init(
                project=wandb.project,
                entity=wandb.entity,
                notes=wandb.notes,
                id=run_id,
                resume="allow" if run_id else None,
                mode=wandb.mode or "online",
                dir=folder,
                config=description,
            )

    def __enter__(self) -> MetricsLogger:
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.close()
        if self._wandb is not None:
            self._wandb.finish(quiet=True)

    @property
    def run_id(self) -> str | None:
        """The run's identifier at Weights & Biases; None without it."""
        return self._wandb.id if self._wandb is not None else None

    def advance(self) -> None:
        """Advance the progress bar by a step."""
        self._bar.update()

    def log_training(self, step: int, row: dict[str, float]) -> None:
        """Log the averages of a window."""
        self._training.add({STEP: step, **row})
        names = {"success": "success", "return": "return", "critic_loss": "critic", "actor_loss": "actor"}
        self._show({short: f"{row[name]:.3g}" for name, short in names.items()})
        self._send("train", step, row)

    def log_evaluation(self, step: int, row: dict[str, float]) -> None:
        """Log the results of an evaluation."""
        self._evaluation.add({STEP: step, **row})
        self._show({"evaluated": f"{row['success']:.0%}"})
        self._send("eval", step, row)

    def _show(self, metrics: dict[str, str]) -> None:
        self._postfix |= metrics
        self._bar.set_postfix(self._postfix, refresh=False)

    def _send(self, prefix: str, step: int, row: dict[str, float]) -> None:
        if self._wandb is not None:
            self._wandb.log({f"{prefix}/{name}": value for name, value in row.items()}, step=step)
