"""The tasks: every module of this folder but `base` defines one, under its own name. A new task is a new file."""

from __future__ import annotations

import importlib
import pkgutil
from typing import TYPE_CHECKING

from lerobot_symview.names import lookup

if TYPE_CHECKING:
    from symview_sim.tasks.base import Task

TASK_NAMES = tuple(sorted(module.name for module in pkgutil.iter_modules(__path__) if module.name != "base"))


def make_task(name: str) -> Task:
    """Return a fresh task; its module is imported now, so that naming tasks does not start a simulator."""
    lookup("task", name, dict.fromkeys(TASK_NAMES))
    module = importlib.import_module(f"{__name__}.{name}")
    task: Task = module.TASK()
    return task
