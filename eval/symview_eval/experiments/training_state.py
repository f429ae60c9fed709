"""The last checkpoint of a training, from which a run that was killed continues.

<folder>/<step>                 a complete checkpoint; the one of the highest step is the last
<folder>/<step>.<random>.part   one whose writing was interrupted, never read
"""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.optim import load_optimizer_state, load_scheduler_state, save_optimizer_state, save_scheduler_state
from lerobot.utils.random_utils import load_rng_state, save_rng_state
from safetensors.torch import load_model, save_model

from lerobot_symview.runtime.staging import part_of, plain

logger = logging.getLogger(__name__)

INTERVAL_S = 300.0  # so that cells of two minutes write none
PROGRESS, POLICY = "progress.json", "policy.safetensors"


@dataclass(frozen=True)
class Learner:
    """What changes in a training step: the policy, its optimizer and schedule, and all random generators."""

    policy: Any
    optimizer: Any
    scheduler: Any
    """None for a constant learning rate."""

    def save(self, folder: Path) -> None:
        """Write safetensors and JSON files."""
        save_model(self.policy, str(folder / POLICY))
        save_optimizer_state(self.optimizer, folder)
        if self.scheduler is not None:
            save_scheduler_state(self.scheduler, folder)
        save_rng_state(folder)

    def load(self, folder: Path) -> None:
        """Restore what `save` wrote, for a learner of the same configuration."""
        load_model(self.policy, folder / POLICY, device=self.policy.config.device)
        load_optimizer_state(self.optimizer, folder)
        if self.scheduler is not None:
            load_scheduler_state(self.scheduler, folder)
        load_rng_state(folder)


class Checkpoints:
    """Checkpoints of one training in a folder of their own; a new one replaces the last.

    Args:
        folder: the folder.
        made_by: software and device of this run; checkpoints of others are not read, since the run would not end with
            the result of an uninterrupted one.
    """

    def __init__(self, folder: Path, made_by: dict[str, str]):
        self._folder, self._made_by = folder, made_by
        self._written = time.monotonic()

    @property
    def is_due(self) -> bool:
        """Whether `INTERVAL_S` seconds have passed since the last checkpoint or the start."""
        return time.monotonic() - self._written >= INTERVAL_S

    def write(self, step: int, save: Callable[[Path], dict[str, Any]]) -> None:
        """Write a checkpoint atomically and remove earlier ones.

        Args:
            step: training steps so far.
            save: writes files into a folder, and returns what else is to be saved, in JSON types.
        """
        earlier = list(self._folder.glob("*"))
        folder = self._folder / f"{step:06d}"
        part = part_of(folder)
        part.mkdir(parents=True)
        content = {"made_by": self._made_by, "step": step} | save(part)
        (part / PROGRESS).write_text(json.dumps(plain(content)))
        part.rename(folder)
        for path in earlier:
            remove(path)
        self._written = time.monotonic()

    def last(self) -> tuple[Path, dict[str, Any]] | None:
        """Return the folder of the last checkpoint and what `save` returned; None if there is none to continue from.

        Checkpoints of other software or another device are removed.
        """
        complete = sorted(path for path in self._folder.glob("*") if path.name.isdigit())
        if not complete:
            return None
        content: dict[str, Any] = json.loads((complete[-1] / PROGRESS).read_text())
        if content["made_by"] == self._made_by:
            return complete[-1], content
        logger.info("training starts from the beginning: its checkpoint is of %s", content["made_by"])
        remove(self._folder)
        return None


def remove(folder: Path) -> None:
    """Remove a folder, if it exists, so that no incomplete checkpoint remains in it if that is interrupted."""
    if folder.exists():
        shutil.rmtree(folder.rename(part_of(folder)))
