"""The sentences of a check of the declared types: what was measured, what is wrong, and what to change."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lerobot_policy_symview.symmetry.declaration_check import Consistency
from lerobot_policy_symview.symmetry.groups import PlanarGroup
from lerobot_policy_symview.symmetry.representations import VectorRepresentation
from lerobot_policy_symview.symmetry.trajectories import MOVING

GAINS, GAIN_RATIO = (0.005, 5.0), 20.0  # motion per frame and unit of action; that of two dimensions
TURN = np.deg2rad(5)  # angle between action and motion that is named
LEAST_CAUSE = 0.1  # root mean square of the motion, relative to all motion, of a dimension that is named


def kind_of(result: Consistency) -> str:
    """Return the type of a vector's first dimension, or of a scalar, without its name."""
    return result.labels[0].split(":")[0]


def measured(result: Consistency, group: PlanarGroup) -> str:
    """Return what was measured of a vector or scalar of the state, as a sentence."""
    name = ", ".join(result.labels)
    if not result.is_known:
        return f"{name}: the actions explain {max(result.explained, 0):.0%} of the motion, too little to compare"
    low, high = result.interval
    rotated, reflected = (
        max((part for index, part in enumerate(result.by_element) if group.reflects(index) == kind), default=0.0)
        for kind in (False, True)
    )
    gain = "" if result.gain is None else f", one unit of action moves it by {result.gain:.2g} in a frame"
    return (
        f"{name}: the actions explain {result.explained:.0%} of the motion{gain}; the declaration contradicts "
        f"{result.contradicted:.1%} of it, 95 % interval {low:.1%} to {high:.1%} (rotated demonstrations up to "
        f"{rotated:.1%}, reflected ones {reflected:.1%})"
    )


def problems(
    result: Consistency,
    results: list[Consistency],
    states: VectorRepresentation,
    actions: VectorRepresentation,
    group: PlanarGroup,
) -> list[str]:
    """Return what is wrong with a vector or scalar of the state."""
    name, flags = " and ".join(result.labels), f"{states.flag} and {actions.flag}"
    if not result.is_known:
        if kind_of(result) != "x":
            return []
        return [
            f"the actions explain {max(result.explained, 0):.0%} of the motion of the state's {name}: check the order "
            f"and the types in {flags}, and whether actions are recorded with the state of the same frame"
        ]
    if result.is_contradicted:
        return [
            f"the demonstrations contradict the declaration of {name} ({result.contradicted:.0%} of the motion): "
            f"{_cause(result, actions, group)}; check the order and the types in {flags}, the base's pose, and the "
            "units and signs of the recording"
        ]
    if result.gain is None or kind_of(result) not in MOVING:
        return []
    if result.gain < 0:
        return [
            f"the action's {name} moves the state's {name} the other way ({result.gain:.2g} for each unit): one of the "
            "two has the wrong sign"
        ]
    horizontal = next((one.gain for one in results if kind_of(one) == "x" and one.is_known and one.gain), None)
    ratio = result.gain / horizontal if horizontal and horizontal > 0 else 1.0
    if not GAINS[0] < result.gain < GAINS[1] or not 1 / GAIN_RATIO < ratio < GAIN_RATIO:
        return [
            f"one unit of the action's {name} moves the state by {result.gain:.2g} in a frame"
            + (f", {ratio:.2g} times as far as x and y" if abs(np.log(ratio)) > 1 else "")
            + ": their units differ"
        ]
    return []


def _cause(result: Consistency, actions: VectorRepresentation, group: PlanarGroup) -> str:
    """Return the most likely reason for which a vector or scalar contradicts its types."""
    own = [index for index, label in enumerate(actions.dimensions) if label in result.labels]
    others = [(size, index) for index, size in enumerate(result.forbidden) if index not in own]
    size, other = max(others, default=(0.0, 0))
    within = max((result.forbidden[index] for index in own), default=0.0)
    if size > max(within, LEAST_CAUSE) or len(own) < 2:
        return f"it follows the action's {actions.dimensions[other]!r}, dimension {other}"
    gains = result.gains[:, [actions.dimensions.index(label) for label in result.labels]]
    element = nearest_element(gains, group)
    if element:
        return f"it moves as if the action were {described(group, element)}"
    turn = np.arctan2(gains[1, 0] - gains[0, 1], gains[0, 0] + gains[1, 1])
    if abs(turn) > TURN:
        return f"it moves at an angle of {np.rad2deg(turn):.0f} degrees to the action"
    first, second = gains[0, 0], gains[1, 1]
    return f"one unit of action moves it by {first:.2g} along the one axis and by {second:.2g} along the other"


def nearest_element(gains: NDArray[np.floating], group: PlanarGroup) -> int:
    """Return the group element whose matrix a map (2, 2) of vectors is the most like, whatever the axes' units."""
    gains = gains / np.maximum(np.abs(gains).max(axis=0, keepdims=True), 1e-12)
    return int(np.einsum("gij,ij->g", group.rotation(), gains).round(6).argmax())


def described(group: PlanarGroup, element: int) -> str:
    """Return an element in words."""
    degrees = round(np.rad2deg(group.angle(element)))
    if element == 0:
        return "as recorded"
    if not group.reflects(element):
        return f"rotated by {degrees} degrees"
    axes = {0: "with y negated", 90: "with x and y swapped", 180: "with x negated", 270: "with -y and -x for x and y"}
    return axes.get(degrees, f"with y negated and rotated by {degrees} degrees")
