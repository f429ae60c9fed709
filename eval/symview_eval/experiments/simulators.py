"""The simulator of each task of the experiments."""

from __future__ import annotations

from typing import Any

from symview_sim.settings import EnvSettings, WorldSettings
from symview_sim.worlds.fetch import FetchSettings
from symview_sim.worlds.metaworld import MetaWorldSettings

METAWORLD_TASKS = (
    "push-v3",
    "pick-place-v3",
    "reach-v3",
    "plate-slide-v3",
    "drawer-open-v3",
    "button-press-topdown-v3",
    "sweep-v3",
    "sweep-into-v3",
    "coffee-push-v3",
)
SETTINGS: dict[str, type[WorldSettings]] = dict.fromkeys(METAWORLD_TASKS, MetaWorldSettings) | {
    "FetchPush": FetchSettings
}
FOREIGN_TASKS = tuple(SETTINGS)


def world_settings(task: str, *, oracle: bool, **settings: Any) -> WorldSettings:
    """Return the settings of a task's simulator; only PyBullet's has an oracle."""
    if task in SETTINGS:
        return SETTINGS[task](task=task, **settings)
    return EnvSettings(task=task, oracle=oracle, **settings)
