"""Looking things up by the name a user typed: ours, and those that installed packages add as entry points."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points


def lookup[Value](kind: str, name: str, known: Mapping[str, Value]) -> Value:
    """Return `known[name]`; an unknown name raises a ValueError that lists the known ones and the nearest."""
    if name not in known:
        guess = difflib.get_close_matches(name, known, n=1)
        hint = f"; did you mean {guess[0]!r}?" if guess else ""
        raise ValueError(f"unknown {kind} {name!r}, expected one of: {', '.join(known)}{hint}")
    return known[name]


@cache
def added(group: str) -> dict[str, EntryPoint]:
    """Return what installed packages add to a group, such as `symview.tasks`, by name, without importing it."""
    return {entry.name: entry for entry in entry_points(group=group)}
