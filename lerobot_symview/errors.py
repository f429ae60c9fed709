"""Mistakes that a user can correct: each message says what was found and what was expected.

The library's messages name no command-line flag: it does not know who calls it. A command adds its flag
(`lerobot_symview.runtime.cli.flagged`).
"""

from __future__ import annotations


class SymviewError(Exception):
    """A mistake that the user can correct; the message says how."""


class CalibrationError(SymviewError, ValueError):
    """A camera's intrinsics or pose cannot describe a pinhole camera over the table."""


class DatasetError(SymviewError):
    """A dataset is missing, malformed, or lacks what is asked of it."""
