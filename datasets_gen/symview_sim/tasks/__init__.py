"""The tasks. Each module of this folder except `base` defines one task, under the module's name.

Add a task of your own with a decorator, which makes it selectable in this process:

```python
from symview_sim.tasks import register_task
from symview_sim.tasks.base import Task


@register_task("my_task")
class MyTask(Task): ...
```

Installed packages add tasks by an entry point in the group `symview.tasks`, such as `my_task = "my_package:MyTask"`.
Worker processes (`--num_workers`, asynchronous evaluation, `symview-train-rl`) see entry points only.
"""

from __future__ import annotations

import pkgutil
from typing import TYPE_CHECKING

from lerobot_symview.registry import Registry

if TYPE_CHECKING:
    from symview_sim.tasks.base import Task

TASK_NAMES = tuple(sorted(module.name for module in pkgutil.iter_modules(__path__) if module.name != "base"))
"""The built-in tasks."""

TASKS: Registry[type[Task]] = Registry(
    "task", "symview.tasks", {name: f"{__name__}.{name}:TASK" for name in TASK_NAMES}
)
register_task = TASKS.register


def check_task(name: str) -> None:
    """Raise a ValueError that lists all tasks unless `name` is one of them."""
    TASKS.check(name)


def make_task(name: str) -> Task:
    """Return a new instance of a task. Its module, and with it PyBullet, is imported only now.

    Raises:
        ValueError: if there is no such task.
    """
    return TASKS[name]()
