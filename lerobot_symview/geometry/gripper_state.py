"""Where a state vector has the gripper's pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import array_api_compat

POSE = ("x", "y", "z", "yaw", "aperture")
REQUIRED = ("x", "y", "z")
ABSENT = {"yaw": 0.0, "aperture": 1.0}  # of a hand that never turns, and of one that never closes


def gripper_columns(names: Sequence[str], turns: bool = False) -> list[int | None] | None:
    """Return the indices of the gripper's x, y, z, yaw and aperture among the names of a state's dimensions.

    Args:
        names: of the state's dimensions.
        turns: whether the gripper turns about the vertical, so that its yaw is needed.

    Returns:
        None in place of a yaw or aperture that the state lacks; None alone if it lacks what is needed.
    """
    if missing_of(names, turns):
        return None
    return [names.index(name) if name in names else None for name in POSE]


def missing_of(names: Sequence[str], turns: bool = False) -> str:
    """Return the names that a state lacks and without which the gripper's pose is unknown, as a text."""
    needed = (*REQUIRED, "yaw") if turns else REQUIRED
    return ", ".join(name for name in needed if name not in names)


def poses_from_states(states: Any, columns: Sequence[int | None]) -> Any:
    """Return the gripper's x, y, z, yaw and aperture of states (..., N): (..., 5), same array type and dtype.

    Args:
        states: numpy array or torch tensor.
        columns: as `gripper_columns` returns them. A gripper without yaw never turns and has yaw 0, one without
            aperture has aperture 1.
    """
    xp = array_api_compat.array_namespace(states)
    values = [
        xp.full_like(states[..., 0], ABSENT[name]) if column is None else states[..., column]
        for name, column in zip(POSE, columns, strict=True)
    ]
    return xp.stack(values, axis=-1)
