"""Timing of calls, and of one function inside a larger computation."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

from tqdm import tqdm


def seconds(call: Callable[[], object]) -> float:
    """Call `call` and return the wall-clock time it takes, seconds."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def medians(calls: Mapping[str, Callable[[], object]], repeats: int, name: str) -> dict[str, float]:
    """Run all calls in turn, once as a warm-up and then `repeats` times; return the median seconds of each.

    Args:
        calls: what to time, by name. With a GPU, its work is waited for: calls return before it has finished.
        repeats: timed runs of each call.
        name: label of the progress bar.
    """
    import torch  # only here: worker processes of other suites import this module

    def synchronized(call: Callable[[], object]) -> None:
        call()
        if torch.cuda.is_available():
            torch.cuda.synchronize()

    times: dict[str, list[float]] = {key: [] for key in calls}
    for repeat in tqdm(range(repeats + 1), desc=name, unit="round", leave=False):
        for key, call in calls.items():
            duration = seconds(lambda call=call: synchronized(call))  # type: ignore[misc]
            if repeat:
                times[key].append(duration)
    return {key: statistics.median(values) for key, values in times.items()}


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
