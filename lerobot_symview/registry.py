"""Registries: what a user selects by name. Built-in entries, entry points of installed packages, and registrations.

```python
from lerobot_symview import register_view


@register_view("mine")
@dataclass(frozen=True)
class MyView(View): ...
```

An installed package adds to the same registry by an entry point, in the group `symview.views`, `symview.tasks` or
`symview.encoders`. Worker processes see entry points; they do not see what was registered in the process that started
them.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, cast


def lookup[Value](kind: str, name: str, known: Mapping[str, Value]) -> Value:
    """Return `known[name]`; an unknown name raises a ValueError that lists the known ones and the nearest."""
    check_name(kind, name, known)
    return known[name]


def check_name(kind: str, name: str, known: Iterable[str]) -> None:
    """Raise a ValueError, with the nearest known name, unless `name` is one of `known`."""
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
    """Named things of one kind.

    Args:
        kind: what error messages call one, such as `view`.
        group: the entry points' group, such as `symview.views`.
        builtin: name -> `module:attribute`, imported when it is first asked for.
    """

    def __init__(self, kind: str, group: str, builtin: Mapping[str, str] | None = None):
        self.kind, self.group = kind, group
        self._builtin = {name: EntryPoint(name, place, group) for name, place in (builtin or {}).items()}
        self._registered: dict[str, Value] = {}

    def register[Item](self, name: str) -> Callable[[Item], Item]:
        """Return a decorator that makes a class or function selectable as `name` in this process.

        Raises:
            ValueError: if the name is taken.
        """
        if name in self:
            raise ValueError(f"a {self.kind} named {name!r} is registered already")

        def register(item: Item) -> Item:
            self._registered[name] = cast(Any, item)
            return item

        return register

    def unregister(self, name: str) -> None:
        """Remove what was registered as `name` in this process."""
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
        """Names that were registered in this process."""
        return tuple(self._registered)

    def check(self, name: str, kind: str | None = None) -> None:
        """Raise a ValueError, with the nearest known name, unless `name` is selectable; `kind` replaces the kind."""
        if name not in self:
            check_name(kind or self.kind, name, self)

    def __getitem__(self, name: str) -> Value:
        """Return what is registered as `name`, imported now if it was not before.

        Raises:
            ValueError: if nothing is; the message has the nearest known name.
        """
        if name in self._registered:
            return self._registered[name]
        self.check(name)
        entry = self._builtin.get(name) or installed(self.group)[name]
        value: Value = entry.load()
        return value
