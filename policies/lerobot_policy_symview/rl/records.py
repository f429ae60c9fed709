"""What a training leaves to read: a progress bar, CSV files, and Weights & Biases if asked for."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from tqdm import tqdm

from lerobot_policy_symview.rl.train_config import TrainRlConfig

STEP = "step"


class Table:
    """A CSV file that grows by a row at a time; a row after the step a training resumes from is dropped.

    Args:
        path: the file.
        last_step: the last step to keep.
    """

    def __init__(self, path: Path, last_step: int):
        self._path = path
        if path.exists():
            header, *rows = path.read_text().splitlines(keepends=True)
            path.write_text("".join([header, *(row for row in rows if int(row.split(",")[0]) <= last_step)]))

    def add(self, row: dict[str, float]) -> None:
        """Append a row; all have the same columns."""
        is_new = not self._path.exists()
        with self._path.open("a", newline="") as stream:
            writer = csv.DictWriter(stream, row, lineterminator="\n")
            if is_new:
                writer.writeheader()
            writer.writerow(row)


def read_table(path: Path) -> list[dict[str, float]]:
    """Return the rows of a table; the column `step` is whole."""
    with path.open(newline="") as stream:
        return [
            {name: int(value) if name == STEP else float(value) for name, value in row.items()}
            for row in csv.DictReader(stream)
        ]


class Records:
    """Everything that is told while a training runs.

    Args:
        config: the run's.
        step: those done before.
        run_id: the run's name at Weights & Biases, if it has one.
        description: of the run, for it.
    """

    def __init__(self, config: TrainRlConfig, step: int, run_id: str | None, description: dict[str, Any]):
        folder, wandb = config.output_dir, config.wandb
        folder.mkdir(parents=True, exist_ok=True)
        self._training = Table(folder / "training.csv", step)
        self._evaluation = Table(folder / "evaluation.csv", step)
        self._bar = tqdm(total=config.steps, initial=step, desc="training", unit="step", dynamic_ncols=True)
        self._shown: dict[str, str] = {}
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

    def __enter__(self) -> Records:
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.close()
        if self._wandb is not None:
            self._wandb.finish(quiet=True)

    @property
    def run_id(self) -> str | None:
        """The run's name at Weights & Biases."""
        return self._wandb.id if self._wandb is not None else None

    def advance(self) -> None:
        """Count a step."""
        self._bar.update()

    def training(self, step: int, row: dict[str, float]) -> None:
        """Tell how the training went since the last row."""
        self._training.add({STEP: step, **row})
        names = {"success": "success", "return": "return", "critic_loss": "critic", "actor_loss": "actor"}
        self._show({short: f"{row[name]:.3g}" for name, short in names.items()})
        self._send("train", step, row)

    def evaluation(self, step: int, row: dict[str, float]) -> None:
        """Tell what an evaluation found."""
        self._evaluation.add({STEP: step, **row})
        self._show({"evaluated": f"{row['success']:.0%}"})
        self._send("eval", step, row)

    def _show(self, measures: dict[str, str]) -> None:
        self._shown |= measures
        self._bar.set_postfix(self._shown, refresh=False)

    def _send(self, kind: str, step: int, row: dict[str, float]) -> None:
        if self._wandb is not None:
            self._wandb.log({f"{kind}/{name}": value for name, value in row.items()}, step=step)
