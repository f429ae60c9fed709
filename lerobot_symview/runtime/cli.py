"""What every console command shares: flags from a dataclass, one-line errors, exit codes."""

from __future__ import annotations

import io
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from lerobot_symview.errors import SymviewError
from lerobot_symview.registry import check_name

USAGE, FAILURE, INTERRUPTED = 2, 1, 130
PACKAGES = ("lerobot_symview", "symview_sim", "lerobot_policy_symview", "symview_eval")


class CommandError(SymviewError):
    """A command cannot do what its flags ask for; the message names the flag to change. Exit code 1, no traceback."""


@contextmanager
def flagged(flag: str) -> Iterator[None]:
    """Add the command-line flag to the message of a library's error.

    Args:
        flag: what to change, such as `--calibration=cameras.yaml`.
    """
    try:
        yield
    except SymviewError as error:
        raise type(error)(f"{flag}: {error}") from None


@dataclass(frozen=True)
class DatasetLocation:
    """Where a dataset is."""

    repo_id: str
    """`user/name`, its name on the Hub."""
    root: Path | None = None
    """Folder; by default LeRobot's own cache folder for `repo_id`."""

    def __post_init__(self) -> None:
        check_repo_id(self.repo_id, "--dataset.repo_id")

    def folder(self) -> Path:
        """Return the folder, resolved."""
        if self.root is not None:
            return Path(self.root).expanduser().resolve()
        from lerobot.utils.constants import HF_LEROBOT_HOME

        return Path(HF_LEROBOT_HOME) / self.repo_id


def check_repo_id(repo_id: str, flag: str) -> None:
    """Raise a ValueError that names `flag`, which states it, unless `repo_id` looks like a name on the Hub."""
    if repo_id.count("/") != 1 or not all(repo_id.split("/")):
        raise ValueError(f"{flag} must look like user/name, got {repo_id!r}")


def run_command[Config](
    config_class: type[Config],
    main: Callable[[Config], object],
    examples: str,
    short: dict[str, str] | None = None,
) -> None:
    """Parse the command line into `config_class`, run `main`, and end the process.

    `short` maps abbreviated flags to the full ones.
    Exit codes: 0 done, 2 a flag is wrong, 1 anything else; a user's mistake is one line on stderr.
    """
    import draccus

    program = Path(sys.argv[0]).name
    if "--version" in sys.argv[1:]:
        from importlib.metadata import version

        sys.stdout.write(f"{program} {version('lerobot_policy_symview')}\n")
        sys.exit(0)
    quiet()
    for index, argument in enumerate(sys.argv):
        flag, equals, value = argument.partition("=")
        sys.argv[index] = (short or {}).get(flag, flag) + equals + value
    if {"-h", "--help"} & set(sys.argv[1:]):
        sys.stdout.write(f"{config_class.__doc__ or ''}\n\nexamples:\n{examples}\n\n")
    complaints = io.StringIO()
    try:
        with redirect_stderr(complaints):
            config = draccus.parse(config_class)
    except SystemExit as end:  # argparse: help was printed, or a flag is unknown and the usage precedes the reason
        reason = complaints.getvalue().strip().rpartition("error: ")[2]
        if end.code:
            _end(program, reason, USAGE)
        raise
    except Exception as error:  # draccus raises what a field's type raises: each is a wrong flag
        _end(program, _reasons(error), USAGE)
    try:
        main(config)
    except ValueError as error:
        _end(program, str(error), USAGE)
    except (SymviewError, OSError) as error:
        _end(program, str(error), FAILURE)
    except KeyboardInterrupt:
        _end(program, "interrupted", INTERRUPTED)
    sys.exit(0)


def subcommand(kind: str, known: Mapping[str, object], default: str = "") -> str:
    """Take the first argument, which names one of `known`, off the command line; a name that is not known ends it.

    Without one it is `default`, which may be no name where only help or the version is asked for.
    """
    name = sys.argv.pop(1) if len(sys.argv) > 1 and not sys.argv[1].startswith("-") else default
    try:
        if name or not {"-h", "--help", "--version"} & set(sys.argv[1:]):
            check_name(kind, name, known)
    except ValueError as error:
        _end(Path(sys.argv[0]).name, str(error), USAGE)
    return name


def quiet() -> None:
    """Show our messages and other libraries' errors: their warnings and inner progress bars say nothing to act upon."""
    warnings.simplefilter("ignore")
    os.environ.setdefault("HF_DATASETS_DISABLE_PROGRESS_BARS", "1")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    for other in logging.root.handlers[:]:
        if type(other) is logging.StreamHandler:  # of LeRobot's import, which logs
            logging.root.removeHandler(other)
    logging.basicConfig(level=logging.ERROR, handlers=[handler])
    for package in PACKAGES:
        logging.getLogger(package).setLevel(logging.INFO)


def _reasons(error: BaseException) -> str:
    """Join an error's message with those of its causes: draccus names the field, its cause the value."""
    messages = [str(error)]
    while error.__cause__ is not None:
        error = error.__cause__
        if str(error) not in messages[-1]:
            messages.append(str(error))
    return ": ".join(message for message in messages if "Couldn't instantiate class" not in message)


def _end(program: str, reason: str, code: int) -> NoReturn:
    sys.stderr.write(f"{program}: error: {' '.join(reason.split())}\n")
    sys.exit(code)
