"""Looking things up by the name a user typed."""

from __future__ import annotations

import difflib
from collections.abc import Mapping


def lookup[Value](kind: str, name: str, known: Mapping[str, Value]) -> Value:
    """Return `known[name]`; an unknown name raises a ValueError that lists the known ones and the nearest."""
    if name not in known:
        guess = difflib.get_close_matches(name, known, n=1)
        hint = f"; did you mean {guess[0]!r}?" if guess else ""
        raise ValueError(f"unknown {kind} {name!r}, expected one of: {', '.join(known)}{hint}")
    return known[name]
