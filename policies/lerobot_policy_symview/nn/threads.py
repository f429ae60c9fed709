"""A thread pool for compiled code that releases the GIL; every thread has its own buffers."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import torch

_callers: set[int] = set()  # identifiers of the threads that are inside `in_threads`


@lru_cache
def _workers(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, "symview")


def _reset_after_fork() -> None:
    """Drop the pools, whose threads do not survive a fork."""
    _workers.cache_clear()
    _callers.clear()


os.register_at_fork(after_in_child=_reset_after_fork)


def in_threads[State, Task](
    work: Callable[[State, Task], None], tasks: Sequence[Task], make: Callable[[], State]
) -> list[State]:
    """Call `work(state, task)` for every task, in as many threads as torch uses; return the threads' states.

    Each thread's state comes from `make()`. The assignment of tasks to threads depends on their number alone, so that
    sums in the states are bit-identical from run to run.
    """
    threads = torch.get_num_threads()
    count = max(1, min(threads, len(tasks)))

    def run(thread: int) -> State:
        with torch.inference_mode():
            state = make()
            for task in tasks[thread::count]:
                work(state, task)
            return state

    def run_alone(thread: int) -> State:
        torch.set_num_threads(1)  # also sets MKL's count, which is the process's: otherwise threads would nest
        return run(thread)

    if count == 1:
        return [run(0)]
    _callers.add(threading.get_ident())
    try:
        return list(_workers(count).map(run_alone, range(count)))
    finally:
        _callers.discard(threading.get_ident())
        if not _callers:
            torch.set_num_threads(threads)
