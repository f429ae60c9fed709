"""Relative actions as recorded, and the absolute targets that they mean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_symview import keys
from lerobot_symview.errors import DatasetError

RELATIVE_TO = "relative_to"
PREFIX = "d"  # of the name of an increment: `dx` is added to `x`


def relative_action_feature(names: Sequence[str]) -> dict[str, Any]:
    """Declare a float32 action whose dimensions `d…` are increments of the state in the same frame.

    `info["symview"]["relative_to"]` names the feature to which they are added.
    """
    meaning = {RELATIVE_TO: keys.STATE}
    return {"dtype": "float32", "shape": (len(names),), "names": list(names), "info": {"symview": meaning}}


def absolute_targets(
    states: NDArray[np.floating],
    actions: NDArray[np.floating],
    state_names: Sequence[str],
    action_names: Sequence[str],
) -> NDArray[np.floating]:
    """Return where relative actions move the gripper: state + action of the same frame.

    Args:
        states: (..., S) metres, rad, apertures in [0, 1].
        actions: (..., A) increments `dx`, `dy`, `dz` (metres), `dyaw` (rad), and targets such as `aperture`.
        state_names: (S,) such as `x, y, z, yaw, aperture`.
        action_names: (A,) such as `dx, dy, dz, dyaw, aperture`.

    Returns:
        (..., A) targets in the frame of the states, by the names without `d`; a yaw lies in [-pi/2, pi/2), because a
        parallel gripper is symmetric under a rotation by pi. A dimension that is a target already is unchanged.

    Raises:
        DatasetError: if an action increases what the state lacks.
    """
    targets = np.array(actions)
    for index, name in enumerate(action_names):
        if not name.startswith(PREFIX):
            continue
        increased = name.removeprefix(PREFIX)
        if increased not in state_names:
            raise DatasetError(f"the action {name!r} increases {increased!r}, the state has {', '.join(state_names)}")
        targets[..., index] += states[..., list(state_names).index(increased)]
        if increased == "yaw":
            targets[..., index] = (targets[..., index] + np.pi / 2) % np.pi - np.pi / 2
    return targets
