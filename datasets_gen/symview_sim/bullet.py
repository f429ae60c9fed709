"""PyBullet, imported and connected without the lines it prints about itself."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def silenced() -> Iterator[None]:
    """Discard what C code writes to standard output and standard error meanwhile."""
    libc = ctypes.CDLL(None)
    libc.fflush(None)
    saved = {stream: os.dup(stream) for stream in (1, 2)}
    null = os.open(os.devnull, os.O_WRONLY)
    for stream in saved:
        os.dup2(null, stream)
    try:
        yield
    finally:
        libc.fflush(None)
        for stream, copy in saved.items():
            os.dup2(copy, stream)
            os.close(copy)
        os.close(null)


with silenced():
    import pybullet
    from pybullet_utils.bullet_client import BulletClient


class _Client(BulletClient):
    def __del__(self) -> None:
        """Leave disconnecting to the scene: at the interpreter's exit BulletClient's own attempt fails noisily."""


def connect() -> Any:
    """Return a new simulator without a window; its methods are PyBullet's functions bound to this simulator."""
    with silenced():
        return _Client(connection_mode=pybullet.DIRECT)


def disconnect(client: Any) -> None:
    """Shut a simulator down."""
    client.disconnect()


__all__ = ["connect", "disconnect", "pybullet", "silenced"]
