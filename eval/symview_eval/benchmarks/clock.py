"""Measuring what a function takes of a larger whole."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any


def seconds(call: Callable[[], object]) -> float:
    """Return how long a call takes."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


class Clock:
    """Replaces a function by itself with a clock.

    Args:
        owner: the module, class or object it belongs to.
        name: its name there.
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
        """Put the function back as it was."""
        setattr(self._owner, self._name, self._function)
