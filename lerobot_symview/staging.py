"""Results appear whole or not at all: they are written beside their place and moved there."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lerobot_symview.cli import CommandError


@contextmanager
def staged(target: Path, flag: str) -> Iterator[Path]:
    """Yield a folder that does not exist yet, to be filled; it becomes `target` when the block ends without an error.

    Raises:
        CommandError: if `target` exists; the message names `flag`, which chooses it.
    """
    if target.exists():
        raise CommandError(f"{target} exists already: choose another {flag} or remove it")
    partial = target.with_name(target.name + ".partial")
    if partial.exists():
        shutil.rmtree(partial)
    partial.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield partial
        partial.rename(target)
    finally:
        if partial.exists():
            shutil.rmtree(partial)
