"""Registrations and third-party packages that exist for the duration of a test."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot_policy_symview.encoders import ENCODERS
from lerobot_symview import registry
from lerobot_symview.views import VIEWS
from symview_sim.tasks import TASKS


@contextmanager
def registered(names: registry.Registry[Any], name: str, item: Any) -> Iterator[None]:
    """Register an item within the block."""
    names.register(name)(item)
    try:
        yield
    finally:
        names.unregister(name)


@contextmanager
def temporary_registrations() -> Iterator[None]:
    """Undo registrations and installed entry points at the end of the block."""
    registries = (ENCODERS, TASKS, VIEWS)
    before = {names.kind: names.registered for names in registries}
    try:
        yield
    finally:
        for names in registries:
            for name in set(names.registered) - set(before[names.kind]):
                names.unregister(name)
        registry.installed.cache_clear()


def install(folder: Path, name: str, entry_points: dict[str, dict[str, str]], monkeypatch) -> None:
    """Make the modules in `folder` and their entry points importable, as pip does, and clear `registry.installed`."""
    facts = folder / f"{name}-1.0.dist-info"
    facts.mkdir(parents=True)
    (facts / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    groups = (
        f"[{group}]\n" + "".join(f"{entry} = {target}\n" for entry, target in added.items())
        for group, added in entry_points.items()
    )
    (facts / "entry_points.txt").write_text("".join(groups))
    monkeypatch.syspath_prepend(str(folder.resolve()))
    registry.installed.cache_clear()
