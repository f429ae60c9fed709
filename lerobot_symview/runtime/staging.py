"""Results appear whole or not at all: they are made in `<target>.partial` and moved to `<target>` in the end.

<target>.partial/request.json         what is made; a command that goes on with it must ask for the same
<target>.partial/request.json.done    the same, once the result is in its place and the rest is being removed
<target>.partial/...                  finished pieces, each complete or absent

A folder of that name with neither is somebody else's and stays as it is.
"""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

from lerobot_symview.runtime.cli import CommandError

REQUEST = "request.json"
DONE = f"{REQUEST}.done"


def partial_folder(target: Path) -> Path:
    """Return where `target` is made."""
    return target.with_name(target.name + ".partial")


def plain(description: Any) -> dict[str, Any]:
    """Return a description as JSON holds it, which is how two are compared."""
    return json.loads(json.dumps(description, default=str))


def is_complete(target: Path, made_from: str, description: dict[str, Any], resume: bool, flag: str) -> bool:
    """Whether an earlier run of the same command made `target`, whose `meta` folder keeps the description `made_from`.

    Raises:
        CommandError: if `target` is something else, or `resume` was not asked for; it names `flag`, which chooses it.
    """
    if not target.exists():
        return False
    file = target / "meta" / made_from
    if resume and file.exists() and json.loads(file.read_text()) == description:
        folder = partial_folder(target)
        if (folder / DONE).exists() or _request(folder) == description:
            remove_partial(folder)
        return True
    raise CommandError(f"{target} exists already: choose another {flag} or remove it")


def open_partial(folder: Path, description: dict[str, Any], resume: bool) -> None:
    """Prepare the folder in which a result is made, or check that the one that is there makes the same result.

    Raises:
        CommandError: if there is one and `resume` was not asked for, or it was begun by another command or by none.
    """
    found = _request(folder)
    if found is not None:
        if not resume:
            raise CommandError(f"{folder} was begun and interrupted: add --resume=true to go on, or remove it")
        different = [key for key in description if found.get(key) != description[key]]
        if different:
            raise CommandError(
                f"{folder} was begun with another {', '.join(different)}: repeat the command that began it or remove it"
            )
        return
    if (folder / DONE).exists():
        remove_partial(folder)
    _check_nobody_elses(folder)
    folder.mkdir(parents=True, exist_ok=True)
    part = part_of(folder / REQUEST)
    part.write_text(json.dumps(description))
    part.replace(folder / REQUEST)


def remove_partial(folder: Path) -> None:
    """Remove the folder in which a result was made. Interrupted, it is still known as ours, and not gone on with."""
    if (folder / REQUEST).exists():
        (folder / REQUEST).replace(folder / DONE)
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != DONE:
            path.unlink()
    (folder / DONE).unlink()
    folder.rmdir()


def _request(folder: Path) -> dict[str, Any] | None:
    """Return what the result in `folder` is to be, None if no command says so there."""
    try:
        found = json.loads((folder / REQUEST).read_text())
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def _check_nobody_elses(folder: Path) -> None:
    if not folder.exists():
        return
    # A command that was killed at its very beginning leaves an unfinished request.
    strangers = ["it is a file"]
    if folder.is_dir():
        strangers = sorted(path.name for path in folder.iterdir() if not path.match(f"{REQUEST}.*.part"))
    if strangers:
        raise CommandError(
            f"results are made in {folder}, which holds what no command of ours put there "
            f"({', '.join(strangers[:3])}): move it elsewhere or choose another folder for the result"
        )


def part_of(path: Path) -> Path:
    """Return a name beside `path`, used by nobody else, for what is not complete yet."""
    return path.with_name(f"{path.name}.{uuid4().hex}.part")


@contextmanager
def disk_errors(folder: Path) -> Iterator[None]:
    """Say what to do when nothing more can be written to `folder`."""
    try:
        yield
    except OSError as error:
        free = shutil.disk_usage(folder).free / 2**20
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        raise CommandError(
            f"cannot write to {folder} ({free:.0f} MiB free): {error}. {'Make room and repeat' if full else 'Repeat'} "
            "the command with --resume=true: what is finished is kept"
        ) from None
