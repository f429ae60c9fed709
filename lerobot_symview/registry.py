"""Registries of views, tasks and encoders: built-in entries, entry points, and entries registered at run time.

```python
from lerobot_symview import register_view


@register_view("mine")
@dataclass(frozen=True)
class MyView(View): ...
```

An installed package adds entries to the same registries through entry points, in the groups `symview.views`,
`symview.tasks` and `symview.encoders`. Worker processes load entry points; they do not inherit entries that were
registered at run time in the parent process.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, cast


def lookup[Value](kind: str, name: str, known: Mapping[str, Value]) -> Value:
    """Return `known[name]`; raise a ValueError that lists the known names and the closest match otherwise."""
    check_name(kind, name, known)
    return known[name]


def check_name(kind: str, name: str, known: Iterable[str]) -> None:
    """Raise a ValueError that suggests the closest known name unless `name` is in `known`."""
    names = list(known)
    if name not in names:
        guess = difflib.get_close_matches(name, names, n=1)
        hint = f"; did you mean {guess[0]!r}?" if guess else ""
        raise ValueError(f"unknown {kind} {name!r}, expected one of: {', '.join(names)}{hint}")


@cache
def installed(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group, such as `symview.tasks`, by name, without importing them."""
    return {entry.name: entry for entry in entry_points(group=group)}


class Registry[Value]:
    """Entries of one kind, such as views, by name.

    Args:
        kind: noun for an entry in error messages, such as `view`.
        group: entry point group, such as `symview.views`.
        builtin: name -> `module:attribute`, imported on first use.
    """

    def __init__(self, kind: str, group: str, builtin: Mapping[str, str] | None = None):
        self.kind, self.group = kind, group
        self._builtin = {name: EntryPoint(name, target, group) for name, target in (builtin or {}).items()}
        self._registered: dict[str, Value] = {}

    def register[Item](self, name: str) -> Callable[[Item], Item]:
        """Return a decorator that makes a class or function selectable as `name` in this process.

        Raises:
            ValueError: if the name is already registered.
        """
        if name in self:
            raise ValueError(f"a {self.kind} named {name!r} is already registered")

        def register(item: Item) -> Item:
            self._registered[name] = cast(Any, item)
            return item

        return register

    def unregister(self, name: str) -> None:
        """Remove the entry that was registered as `name` in this process."""
        del self._registered[name]

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*self._builtin, *self._registered, *installed(self.group))))

    def __contains__(self, name: object) -> bool:
        return name in self._builtin or name in self._registered or name in installed(self.group)

    @property
    def builtin(self) -> tuple[str, ...]:
        """Names of the built-in entries."""
        return tuple(self._builtin)

    @property
    def registered(self) -> tuple[str, ...]:
        """Names of the entries registered in this process."""
        return tuple(self._registered)

    def check(self, name: str, kind: str | None = None) -> None:
        """Raise a ValueError that suggests the closest known name if `name` is unknown; `kind` overrides the noun."""
        if name not in self:
            check_name(kind or self.kind, name, self)

    def __getitem__(self, name: str) -> Value:
        """Return the entry `name`; it is imported on first use.

        Raises:
            ValueError: if the name is unknown; the message suggests the closest known name.
        """
        if name in self._registered:
            return self._registered[name]
        self.check(name)
        entry = self._builtin.get(name) or installed(self.group)[name]
        value: Value = entry.load()
        return value
