"""Results are written atomically: to `<target>.partial`, which is renamed to `<target>` once it is complete.

<target>.partial.lock                 locked by the run that writes the result
<target>.partial/request.json         settings of the result; a resumed run must have the same settings
<target>.partial/request.json.done    the same file, renamed once the result is moved and the folder is being removed
<target>.partial/dataset              the result, moved to <target> at the end
<target>.partial/...                  finished parts, each complete or absent

A folder of that name without either file was not created by this module and is never modified.
"""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

from lerobot_symview.runtime.cli import CommandError
from lerobot_symview.runtime.locking import locked

REQUEST = "request.json"
DONE = f"{REQUEST}.done"
DATASET = "dataset"


def partial_folder(target: Path) -> Path:
    """Return the folder in which `target` is written."""
    return target.with_name(target.name + ".partial")


def plain(description: Any) -> dict[str, Any]:
    """Convert a description to JSON types, so that two descriptions can be compared."""
    return json.loads(json.dumps(description, default=str))


def is_complete(target: Path, made_from: str, description: dict[str, Any], resume: bool, flag: str) -> bool:
    """Whether `target` is the complete result of an earlier run with the same description.

    Args:
        target: folder of the result.
        made_from: file in the `meta` folder of `target` that holds its description, and may hold more.
        description: settings of this run.
        resume: whether to accept an existing result.
        flag: command-line flag that sets `target`.

    Raises:
        CommandError: if `target` exists and has another description, or `resume` is False, or if the run that wrote it
            is still removing its partial folder.
    """
    if not target.exists():
        return False
    file = target / "meta" / made_from
    if not (resume and file.exists() and description.items() <= json.loads(file.read_text()).items()):
        raise CommandError(f"{target} exists already: choose another {flag} or remove it")
    folder = partial_folder(target)
    if folder.exists():
        with _locked(target, flag):
            if (folder / DONE).exists() or _request(folder) == description:
                remove_partial(folder)
    return True


@contextmanager
def new_result(target: Path, description: dict[str, Any], resume: bool, flag: str) -> Iterator[None]:
    """Write `target` inside the context: open its partial folder, lock it, and at the end move the result to `target`.

    Args:
        target: folder of the result, which is written to `DATASET` in the partial folder.
        description: settings of this run.
        resume: whether to continue an interrupted run.
        flag: command-line flag that sets `target`.

    Raises:
        CommandError: if another run is writing `target` or has written it meanwhile, or as `open_partial` does.
    """
    folder = partial_folder(target)
    with _locked(target, flag):
        if target.exists():
            raise CommandError(f"{target} exists already: choose another {flag} or remove it")
        open_partial(folder, description, resume)
        yield
        if target.exists():
            raise CommandError(
                f"another program has created {target}: move it elsewhere and repeat the command with --resume=true"
            )
        (folder / DATASET).rename(target)
        remove_partial(folder)


def _locked(target: Path, flag: str) -> AbstractContextManager[None]:
    folder = partial_folder(target)
    return locked(folder.with_name(f"{folder.name}.lock"), target, flag)


def open_partial(folder: Path, description: dict[str, Any], resume: bool) -> None:
    """Create the folder of a partial result, or check that the existing one has the same description.

    Raises:
        CommandError: if the folder exists and `resume` is False, it has another description, or it was not created by
            this module.
    """
    request = _request(folder)
    if request is not None:
        if not resume:
            raise CommandError(f"{folder} is from an interrupted run: add --resume=true to continue, or remove it")
        different = [key for key in description if request.get(key) != description[key]]
        if different:
            raise CommandError(
                f"{folder} is from a run with different {', '.join(different)}: repeat that command or remove it"
            )
        return
    if (folder / DONE).exists():
        remove_partial(folder)
    _check_no_foreign_files(folder)
    folder.mkdir(parents=True, exist_ok=True)
    part = part_of(folder / REQUEST)
    part.write_text(json.dumps(description))
    part.replace(folder / REQUEST)


def remove_partial(folder: Path) -> None:
    """Remove a partial folder. After an interruption it is still recognised, and it is never resumed."""
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
    """Return the description of the partial result in `folder`; None if there is none."""
    try:
        request = json.loads((folder / REQUEST).read_text())
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    return request if isinstance(request, dict) else None


def _check_no_foreign_files(folder: Path) -> None:
    if not folder.exists():
        return
    # A command that was killed at its start leaves a temporary request file.
    foreign = ["it is a file"]
    if folder.is_dir():
        foreign = sorted(path.name for path in folder.iterdir() if not path.match(f"{REQUEST}.*.part"))
    if foreign:
        raise CommandError(
            f"{folder} is needed for partial results and was not created by an earlier run "
            f"({', '.join(foreign[:3])}): move it elsewhere or choose another folder for the result"
        )


def part_of(path: Path) -> Path:
    """Return a unique temporary path beside `path`, for an incomplete file."""
    return path.with_name(f"{path.name}.{uuid4().hex}.part")


@contextmanager
def disk_errors(folder: Path) -> Iterator[None]:
    """Convert write errors in `folder` to a CommandError that names the remedy."""
    try:
        yield
    except OSError as error:
        free = shutil.disk_usage(folder).free / 2**20
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        raise CommandError(
            f"cannot write to {folder} ({free:.0f} MiB free): {error}. {'Free space and repeat' if full else 'Repeat'} "
            "the command with --resume=true: finished parts are kept"
        ) from None
