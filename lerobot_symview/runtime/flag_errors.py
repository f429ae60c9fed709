"""Errors of flags that LeRobot's commands parse, in a form that these commands print."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from draccus.utils import DecodingError

from lerobot_symview.errors import OptionError, SymviewError


class FlagError(OptionError, DecodingError):
    """A flag has an invalid value; the message names the flag, the value and what is expected.

    draccus passes its own `DecodingError` on, and LeRobot's commands print its message. Of other errors in the
    constructor of a configuration, they print the name of the class only.
    """

    def __init__(self, message: str):
        DecodingError.__init__(self, (), message)
        self.args = (message,)  # from which the error is unpickled


@contextmanager
def flag_errors(prefix: str = "") -> Iterator[None]:
    """Turn errors of a configuration's values into a `FlagError`, and prefix their messages.

    Args:
        prefix: the flag, such as `--env: `, unless the messages name it.
    """
    try:
        yield
    except (ValueError, SymviewError) as error:
        raise FlagError(f"{prefix}{error}") from None
