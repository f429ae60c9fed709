"""Where work runs: in this process, in several, or on a Ray cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partialmethod
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import wait
from types import TracebackType
from typing import Any, Protocol, Self

from tqdm import tqdm

from lerobot_symview.runtime.cli import CommandError, quiet


class Executor(Protocol):
    """Runs functions that can be pickled; a context manager."""

    def run[A, R](self, function: Callable[[A], R], arguments: Iterable[A]) -> Iterator[R]:
        """Start `function(argument)` for every argument; return the results in the order in which they are done."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class SerialExecutor:
    """Runs everything here, one after the other."""

    def run[A, R](self, function: Callable[[A], R], arguments: Iterable[A]) -> Iterator[R]:
        """Yield the results in order."""
        yield from map(function, arguments)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


class ProcessExecutor:
    """Runs in processes of this machine.

    Args:
        num_workers: how many processes.
        module: what they are going to run; imported at once and once for all, while the caller prepares their work,
            unless this process has started others before.
    """

    def __init__(self, num_workers: int, module: str):
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([module])
        resource_tracker.ensure_running()  # else the server starts it, which unblocks signals
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # Ctrl-C is this process's to answer
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        self._pool = ProcessPoolExecutor(num_workers, mp_context=context, initializer=_start_worker)

    def run[A, R](self, function: Callable[[A], R], arguments: Iterable[A]) -> Iterator[R]:
        """Yield the results as they come.

        Raises:
            CommandError: if a process dies.
        """
        with _worker_deaths():
            return self._results([self._pool.submit(function, argument) for argument in arguments])

    def _results[R](self, futures: list[Future[R]]) -> Iterator[R]:
        with _worker_deaths():
            for future in as_completed(futures):
                yield future.result()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is KeyboardInterrupt:  # who wants to stop does not want to wait for what is under way
            for process in multiprocessing.active_children():
                process.terminate()
        self._pool.shutdown(wait=True, cancel_futures=True)


class RayExecutor:
    """Runs on the Ray cluster that `RAY_ADDRESS` names, or on a local one.

    The cluster's machines must see the same folders and have this package installed.

    Args:
        num_workers: processes of a local cluster.
        module: what they are going to run, imported when they do.
    """

    def __init__(self, num_workers: int, module: str):
        try:
            import ray
        except ImportError:
            raise CommandError(
                "--executor=ray needs Ray: install the extra with `pip install 'lerobot_policy_symview[ray]'`"
            ) from None
        self._ray = ray
        local = None if "RAY_ADDRESS" in os.environ else num_workers
        ray.init(num_cpus=local, include_dashboard=False, log_to_driver=False, logging_level="error")

    def run[A, R](self, function: Callable[[A], R], arguments: Iterable[A]) -> Iterator[R]:
        """Yield the results as they come; Ray repeats what a lost worker had begun."""
        task = self._ray.remote(lambda argument: function(argument))
        return self._results([task.remote(argument) for argument in arguments])

    def _results(self, pending: list[Any]) -> Iterator[Any]:
        try:
            while pending:
                done, pending = self._ray.wait(pending)
                yield self._ray.get(done[0])
        except self._ray.exceptions.RayTaskError as error:
            raise error.cause from None
        except self._ray.exceptions.RayError as error:
            raise CommandError(
                f"the Ray cluster failed, repeat the command, with --resume=true if it has that flag: {error}"
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ray.shutdown()


EXECUTORS: dict[str, Callable[[int, str], Executor]] = {
    "local": lambda workers, module: SerialExecutor() if workers == 1 else ProcessExecutor(workers, module),
    "ray": RayExecutor,
}


@contextmanager
def _worker_deaths() -> Iterator[None]:
    try:
        yield
    except BrokenProcessPool:
        raise CommandError(
            "a worker process died, perhaps for lack of memory: repeat the command with a smaller --num_workers, "
            "and with --resume=true if it has that flag"
        ) from None


def _start_worker() -> None:
    """Leave Ctrl-C to the parent, and end when it does: a worker whose parent is killed would wait for ever."""
    quiet()
    # Bars of several processes would overwrite each other.
    tqdm.__init__ = partialmethod(tqdm.__init__, disable=True)  # type: ignore[method-assign, assignment]
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
