"""Work shared among threads that run compiled code, each with buffers of its own."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import torch

_callers: set[int] = set()  # threads that have work done in threads


@lru_cache
def _workers(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, "symview")


def _forget() -> None:
    """Threads do not survive a fork."""
    _workers.cache_clear()
    _callers.clear()


os.register_at_fork(after_in_child=_forget)


def in_threads[State, Task](
    work: Callable[[State, Task], None], tasks: Sequence[Task], make: Callable[[], State]
) -> list[State]:
    """Call `work(state, task)` for every task, in as many threads as torch uses; return each thread's `make()`.

    Which thread has which task follows from their numbers alone, so that what a thread sums up is the same every time.
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
        torch.set_num_threads(1)  # and MKL's, which is the process's: products would start threads in threads
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
