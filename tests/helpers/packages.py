"""Packages of others, installed for as long as a test runs."""

from pathlib import Path

from lerobot_symview import registry


def install(folder: Path, name: str, entry_points: dict[str, dict[str, str]], monkeypatch) -> None:
    """Make the modules in `folder` and their entry points importable, as pip does; clear `registry.installed` after."""
    facts = folder / f"{name}-1.0.dist-info"
    facts.mkdir(parents=True)
    (facts / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    groups = (
        f"[{group}]\n" + "".join(f"{one} = {place}\n" for one, place in added.items())
        for group, added in entry_points.items()
    )
    (facts / "entry_points.txt").write_text("".join(groups))
    monkeypatch.syspath_prepend(str(folder.resolve()))
    registry.installed.cache_clear()
