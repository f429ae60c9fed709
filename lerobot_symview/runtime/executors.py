"""Executors: run functions in this process, in worker processes, or on a Ray cluster."""

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
    """Context manager that runs picklable functions."""

    def run[A, R](self, function: Callable[[A], R], arguments: Iterable[A]) -> Iterator[R]:
        """Start `function(argument)` for every argument; return the results in order of completion."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class SerialExecutor:
    """Executor that runs functions sequentially in this process."""

    def run[A, R](self, function: Callable[[A], R], arguments: Iterable[A]) -> Iterator[R]:
        """Yield the results in the order of the arguments."""
        yield from map(function, arguments)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


class ProcessExecutor:
    """Executor with worker processes on this machine.

    Args:
        num_workers: number of processes.
        module: module that the workers use. The fork server imports it once for all workers while the caller prepares
            their work, unless this process already has a running fork server.
    """

    def __init__(self, num_workers: int, module: str):
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([module])
        resource_tracker.ensure_running()  # otherwise the fork server starts it, which unblocks signals
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # this process handles Ctrl-C
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        self._pool = ProcessPoolExecutor(num_workers, mp_context=context, initializer=_start_worker)

    def run[A, R](self, function: Callable[[A], R], arguments: Iterable[A]) -> Iterator[R]:
        """Yield the results in order of completion.

        Raises:
            CommandError: if a worker process dies.
        """
        with _worker_errors():
            return self._results([self._pool.submit(function, argument) for argument in arguments])

    def _results[R](self, futures: list[Future[R]]) -> Iterator[R]:
        with _worker_errors():
            for future in as_completed(futures):
                yield future.result()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is KeyboardInterrupt:  # do not wait for running work after an interrupt
            for process in multiprocessing.active_children():
                process.terminate()
        self._pool.shutdown(wait=True, cancel_futures=True)


class RayExecutor:
    """Executor on the Ray cluster at `RAY_ADDRESS`, or on a local cluster.

    The cluster's machines must share the folders and have this package installed.

    Args:
        num_workers: number of processes of a local cluster.
        module: module that the workers use; they import it on first use.
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
        """Yield the results in order of completion; Ray restarts the tasks of lost workers."""
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
                f"the Ray cluster failed: repeat the command, with --resume=true if it has that flag: {error}"
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
def _worker_errors() -> Iterator[None]:
    try:
        yield
    except BrokenProcessPool:
        raise CommandError(
            "a worker process died, possibly out of memory: repeat the command with a smaller --num_workers, "
            "and with --resume=true if it has that flag"
        ) from None


def _start_worker() -> None:
    """Ignore Ctrl-C, and exit with the parent: the worker of a killed parent would wait forever."""
    quiet()
    # Progress bars of several processes would overwrite each other.
    tqdm.__init__ = partialmethod(tqdm.__init__, disable=True)  # type: ignore[method-assign, assignment]
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
