"""Work shared among threads that run compiled code, each with buffers of its own."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import torch


@lru_cache
def _workers(count: int) -> ThreadPoolExecutor:
    threads = torch.get_num_threads()
    pool = ThreadPoolExecutor(count, "symview", initializer=torch.set_num_threads, initargs=(1,))
    barrier = threading.Barrier(count)
    list(pool.map(lambda _: barrier.wait(), range(count)))  # start all, then undo what they set for threads to come
    torch.set_num_threads(threads)
    return pool


os.register_at_fork(after_in_child=_workers.cache_clear)  # threads do not survive a fork


def in_threads[State, Task](
    work: Callable[[State, Task], None], tasks: Sequence[Task], make: Callable[[], State]
) -> list[State]:
    """Call `work(state, task)` for every task, in as many threads as torch uses; return each thread's `make()`.

    Which thread has which task follows from their numbers alone, so that what a thread sums up is the same every time.
    """
    count = max(1, min(torch.get_num_threads(), len(tasks)))

    def run(thread: int) -> State:
        with torch.inference_mode():
            state = make()
            for task in tasks[thread::count]:
                work(state, task)
            return state

    if count == 1:
        return [run(0)]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # MKL has one number for all threads: with more, every product would start threads again
    try:
        return list(_workers(count).map(run, range(count)))
    finally:
        torch.set_num_threads(threads)
