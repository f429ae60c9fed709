"""Errors that a user can correct. Each message gives the value received and the value expected.

Library messages name no command-line flag, because Python code calls the same functions. Commands add their flag with
`lerobot_symview.runtime.cli.flagged`.
"""

from __future__ import annotations


class SymviewError(Exception):
    """Base class of errors that a user can correct; the message says how."""


class OptionError(SymviewError):
    """An option of a view, camera, workspace or environment has an invalid value.

    It is no `ValueError`: draccus, LeRobot's command-line parser, hides the message of a `ValueError`.
    """


class CalibrationError(SymviewError, ValueError):
    """A camera's intrinsics or pose are invalid, or too little of the workspace is in its image."""


class KinematicsError(SymviewError, ValueError):
    """A robot's model or joints are invalid or contradict each other, or a pose is out of reach."""


class DatasetError(SymviewError):
    """A dataset is missing or malformed, or lacks a required feature or file."""


class DivergenceError(SymviewError):
    """A policy's action, its weights or the loss of its training are not finite numbers."""
