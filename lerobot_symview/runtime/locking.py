"""A lock on what a run writes: while the run is alive, a second one is refused in one line.

The kernel holds the lock for the process that locked the file and releases it when the process ends, however it ends.
Programs that the process starts do not inherit the lock, nor do the workers of `lerobot_symview.runtime.executors`,
which the fork server starts.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from lerobot_symview.runtime.cli import CommandError

logger = logging.getLogger(__name__)

RUN_LOCK = "run.lock"  # in the output folder of a command that works in it directly
UNSUPPORTED = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # by some network file systems


@contextmanager
def locked(file: Path, target: Path, flag: str) -> Iterator[None]:
    """Hold the lock on `target` inside the context.

    Args:
        file: the lock file. It is removed at the end; one that a killed run has left is not locked and is used again.
        target: what the run writes.
        flag: command-line flag that sets `target`.

    Raises:
        CommandError: if another run holds the lock, or the file cannot be written.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        stream = file.open("a+")
    except OSError as error:
        raise CommandError(f"cannot write to {file.parent} ({error.strerror}): choose another {flag}") from None
    with stream:
        if not _lock(stream):
            stream.seek(0)
            holder = stream.read() or "another run"
            raise CommandError(f"{target} is being written by {holder}: wait until it ends, or choose another {flag}")
        stream.truncate(0)
        stream.write(f"process {os.getpid()} on {platform.node()}")
        stream.flush()
        try:
            yield
        finally:
            file.unlink(missing_ok=True)  # while it is locked: later it might be another run's


def _lock(stream: TextIO) -> bool:
    """Lock a file; return False if another run has locked it, or has ended just now and removed it."""
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in UNSUPPORTED:
            raise
        logger.warning("%s is not locked (%s): do not start a second run", stream.name, error.strerror)
    return os.fstat(stream.fileno()).st_nlink > 0
