"""Timing of a call, and of one function inside a larger computation."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any


def seconds(call: Callable[[], object]) -> float:
    """Call `call` and return the wall-clock time it takes, seconds."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


class Clock:
    """Wraps a function in place and accumulates the wall-clock time of its calls in `milliseconds`.

    Args:
        owner: the module, class or object that has the function as an attribute.
        name: name of the attribute.
    """

    def __init__(self, owner: Any, name: str):
        self.milliseconds = 0.0
        self._owner, self._name, self._function = owner, name, getattr(owner, name)
        function = self._function

        def timed(*arguments: Any, **options: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                self.milliseconds += 1000 * (time.perf_counter() - start)

        setattr(owner, name, timed)

    def remove(self) -> None:
        """Restore the original function."""
        setattr(self._owner, self._name, self._function)
