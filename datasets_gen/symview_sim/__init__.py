"""PyBullet tasks with scripted experts and freely placed cameras. Importing this package does not import PyBullet."""

import gymnasium

from symview_sim.tasks import TASK_NAMES

__all__ = ["TASK_NAMES", "gym_id"]


def gym_id(task: str) -> str:
    """Return the Gymnasium id of a task: `block_picking` is `symview/BlockPicking-v0`."""
    return f"symview/{task.title().replace('_', '')}-v0"


for _task in TASK_NAMES:
    gymnasium.register(id=gym_id(_task), entry_point="symview_sim.env:make_env", kwargs={"task": _task})
