"""Work shared among threads that run compiled code, each with buffers of its own."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable, Iterable
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
    work: Callable[[State, Task], None], tasks: Iterable[Task], make: Callable[[], State]
) -> list[State]:
    """Call `work(state, task)` for every task, in as many threads as torch uses; return each thread's `make()`."""
    todo: queue.SimpleQueue[Task] = queue.SimpleQueue()
    for task in tasks:
        todo.put(task)
    count = min(torch.get_num_threads(), todo.qsize())

    def run(_: int) -> State:
        with torch.inference_mode():
            state = make()
            while True:
                try:
                    task = todo.get_nowait()
                except queue.Empty:
                    return state
                work(state, task)

    return [run(0)] if count <= 1 else list(_workers(count).map(run, range(count)))
