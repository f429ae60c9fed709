"""Command lines of all console commands: flags from a dataclass, one-line errors, exit codes."""

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

from lerobot_symview.errors import OptionError, SymviewError
from lerobot_symview.registry import check_name
from lerobot_symview.runtime.parse_errors import reason, unknown_flags

USAGE, FAILURE, INTERRUPTED = 2, 1, 130
PACKAGES = ("lerobot_symview", "symview_sim", "lerobot_policy_symview", "symview_eval")


class CommandError(SymviewError):
    """A command failed; the message names the remedy. The command exits with code 1 and prints no traceback."""


@contextmanager
def flagged(flag: str) -> Iterator[None]:
    """Prefix the messages of library errors with a command-line flag.

    Args:
        flag: the flag to change, such as `--calibration=cameras.yaml`.
    """
    try:
        yield
    except SymviewError as error:
        raise type(error)(f"{flag}: {error}") from None


@dataclass(frozen=True)
class DatasetLocation:
    """Name and folder of a dataset."""

    repo_id: str
    """`user/name` of the dataset on the Hub."""
    root: Path | None = None
    """Folder; by default LeRobot's cache folder for `repo_id`."""

    def __post_init__(self) -> None:
        check_repo_id(self.repo_id, "--dataset.repo_id")

    def folder(self) -> Path:
        """Return the absolute folder."""
        if self.root is not None:
            return Path(self.root).expanduser().resolve()
        from lerobot.utils.constants import HF_LEROBOT_HOME

        return Path(HF_LEROBOT_HOME) / self.repo_id


def check_repo_id(repo_id: str, flag: str) -> None:
    """Raise a ValueError that names `flag` unless `repo_id` has the form user/name."""
    if repo_id.count("/") != 1 or not all(repo_id.split("/")):
        raise ValueError(f"{flag} must look like user/name, got {repo_id!r}")


def run_command[Config](
    config_class: type[Config],
    main: Callable[[Config], object],
    examples: str,
    short: dict[str, str] | None = None,
) -> None:
    """Parse the command line into `config_class`, run `main`, and exit.

    `short` maps abbreviated flags to full flags. Exit codes: 0 success, 2 invalid flag, 1 other errors, 130
    interrupted. Errors that a user can correct are printed as one line on stderr.
    """
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
    usage_errors = io.StringIO()
    try:
        with redirect_stderr(usage_errors):
            config = _parsed(config_class)
    except SystemExit as end:  # argparse printed help, or usage and then the error of an unknown flag
        if end.code:
            _end(program, unknown_flags(usage_errors.getvalue()), USAGE)
        raise
    except Exception as error:  # draccus passes on any error of a field's type: each is an invalid flag
        _end(program, reason(error), USAGE)
    try:
        main(config)
    except (ValueError, OptionError) as error:
        _end(program, str(error), USAGE)
    except (SymviewError, OSError) as error:
        _end(program, str(error), FAILURE)
    except KeyboardInterrupt:
        _end(program, "interrupted", INTERRUPTED)
    sys.exit(0)


def _parsed[Config](config_class: type[Config]) -> Config:
    """Parse the command line as `draccus.parse` does, but a boolean flag needs no value: `--resume` is true."""
    from draccus.argparsing import ArgumentParser

    parser: ArgumentParser[Config] = ArgumentParser(config_class)
    for action in parser.parser._actions:
        if action.type in (bool, bool | None):
            action.nargs, action.const = "?", "true"
    return parser.parse_args()


def subcommand(kind: str, known: Mapping[str, object], default: str = "") -> str:
    """Remove the subcommand, one of `known`, from the command line and return it; exit if it is unknown.

    Without a subcommand return `default`. An empty name is accepted with --help and --version only.
    """
    name = sys.argv.pop(1) if len(sys.argv) > 1 and not sys.argv[1].startswith("-") else default
    try:
        if name or not {"-h", "--help", "--version"} & set(sys.argv[1:]):
            check_name(kind, name, known)
    except ValueError as error:
        _end(Path(sys.argv[0]).name, str(error), USAGE)
    return name


def quiet() -> None:
    """Log this project's messages and only errors of other libraries; hide their warnings and progress bars."""
    warnings.simplefilter("ignore")
    os.environ.setdefault("HF_DATASETS_DISABLE_PROGRESS_BARS", "1")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    for other in logging.root.handlers[:]:
        if type(other) is logging.StreamHandler:  # added by the import of LeRobot
            logging.root.removeHandler(other)
    logging.basicConfig(level=logging.ERROR, handlers=[handler])
    for package in PACKAGES:
        logging.getLogger(package).setLevel(logging.INFO)


def _end(program: str, problem: str, code: int) -> NoReturn:
    sys.stderr.write(f"{program}: error: {' '.join(problem.split())}\n")
    sys.exit(code)
