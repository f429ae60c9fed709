"""The tasks: every module of this folder but `base` defines one, under its own name. A new task is a new file.

Other packages add theirs as entry points: in the group `symview.tasks`, name = "module:Class".
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import TYPE_CHECKING

from lerobot_symview.registry import installed, lookup

if TYPE_CHECKING:
    from symview_sim.tasks.base import Task

TASK_NAMES = tuple(sorted(module.name for module in pkgutil.iter_modules(__path__) if module.name != "base"))


def check_task(name: str) -> None:
    """Raise ValueError, with the names there are, if there is no such task."""
    if name not in TASK_NAMES:
        lookup("task", name, dict.fromkeys((*TASK_NAMES, *installed("symview.tasks"))))


def make_task(name: str) -> Task:
    """Return a fresh task; its module is imported now, so that naming tasks does not start a simulator."""
    check_task(name)
    is_ours = name in TASK_NAMES
    make = importlib.import_module(f"{__name__}.{name}").TASK if is_ours else installed("symview.tasks")[name].load()
    task: Task = make()
    return task
