"""Types that are right pass on any consistent motion; each kind of wrong type is contradicted, in its dimension."""

import numpy as np
import pytest

from lerobot_policy_symview.symmetry.declaration_check import LEAST_EPISODES, consistency, motion
from lerobot_policy_symview.symmetry.groups import make_group
from lerobot_policy_symview.symmetry.representations import VectorRepresentation

TYPES = ("x", "y", "z", "yaw", "aperture")
D4 = make_group("D4")


def demonstrations(noise=0.0, gain=0.5, episodes=8, seed=0, frames=60):
    """Smooth actions whose dimensions are correlated, and states that follow them by `gain`."""
    rng = np.random.default_rng(seed)
    mixing = np.eye(4) + 0.3 * rng.normal(size=(4, 4))
    states, actions = [], []
    for _ in range(episodes):
        raw = rng.normal(size=(frames + 9, 4)) @ mixing.T
        increments = 0.01 * np.stack([raw[t : t + 10].mean(axis=0) for t in range(frames)])
        pose = rng.normal(size=4) * 0.05 + gain * np.cumsum(increments, axis=0) - gain * increments
        pose[:, 3] = (pose[:, 3] + np.pi / 2) % np.pi - np.pi / 2
        closing = np.linspace(1.0, 0.0, frames)[:, None] > 0.5
        states.append(np.hstack([pose, closing]) + noise * rng.normal(size=(frames, 5)))
        actions.append(np.hstack([increments, closing]))
    return states, actions


def results(states, actions, state_types=TYPES, action_types=TYPES, mode="delta", window=3, group=D4):
    moved = motion(states, actions, VectorRepresentation(state_types), VectorRepresentation(action_types), mode, window)
    return {result.labels[0]: result for result in consistency(moved, group)}


def mapped(vectors, matrix):
    """Vectors whose x and y are mapped by a matrix (2, 2)."""
    changed = [values.copy() for values in vectors]
    for values in changed:
        values[:, :2] = values[:, :2] @ np.transpose(matrix)
    return changed


def scaled(vectors, index, factor):
    return [values * np.where(np.arange(values.shape[1]) == index, factor, 1) for values in vectors]


def rotation(degrees):
    cos, sin = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return [[cos, -sin], [sin, cos]]


@pytest.mark.parametrize("noise", [0.0, 0.001])
@pytest.mark.parametrize("group", ["D4", "C4", "D8"])
def test_consistent_demonstrations_do_not_contradict_their_types(noise, group):
    found = results(*demonstrations(noise), group=make_group(group))
    assert set(found) >= {"x", "z", "yaw"}
    for label in ("x", "z", "yaw"):
        assert found[label].explained > 0.8
        assert found[label].contradicted < 0.02
        assert not found[label].is_contradicted
        assert found[label].gain == pytest.approx(0.5, rel=0.1)


SWAPPED = [[0, 1], [1, 0]]
FAULTS = {
    "x and y swapped": (SWAPPED, "action", 0.9),
    "x negated": (np.diag([-1, 1]), "action", 0.9),
    "y of the state negated": (np.diag([1, -1]), "state", 0.9),
    "a base turned by 90 degrees": (rotation(90), "state", 0.9),
    "a base turned by 20 degrees": (rotation(20), "action", 0.08),
    "x in millimetres": (np.diag([1000, 1]), "action", 0.3),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("noise", [0.0, 0.0005])
def test_a_wrong_frame_of_the_horizontal_is_contradicted(fault, noise):
    matrix, where, least = FAULTS[fault]
    states, actions = demonstrations(noise)
    if where == "state":
        states = mapped(states, matrix)
    else:
        actions = mapped(actions, matrix)
    found = results(states, actions)
    assert found["x"].is_contradicted
    assert found["x"].contradicted > least
    assert not any(found[label].is_contradicted for label in ("z", "yaw"))


@pytest.mark.parametrize(
    ("declared", "contradicted"),
    [
        (("y", "x", "z", "yaw", "aperture"), {"x"}),
        (("z", "y", "x", "yaw", "aperture"), {"x", "z"}),
        (("x", "y", "yaw", "z", "aperture"), {"z", "yaw"}),
        (("yaw", "y", "z", "x", "aperture"), {"x", "yaw"}),
        (("x", "y", "z", "scalar", "aperture"), {"yaw"}),
        (("x", "y", "sign", "yaw", "aperture"), {"z"}),
    ],
)
def test_a_wrong_type_of_an_action_is_contradicted(declared, contradicted):
    found = results(*demonstrations(0.0005), action_types=declared)
    assert {label for label, result in found.items() if result.is_contradicted} == contradicted


def test_rotations_and_reflections_are_told_apart():
    """A frame that is turned by 90 degrees commutes with rotations, one of the wrong sign with one reflection."""
    states, actions = demonstrations()
    turned = results(mapped(states, rotation(90)), actions)["x"].by_element
    assert max(turned[:4]) < 0.01
    assert min(turned[4:]) > 0.7  # each alone permits a symmetric map
    assert not results(mapped(states, rotation(90)), actions, group=make_group("C4"))["x"].is_contradicted
    negated = results(mapped(states, np.diag([1, -1])), actions)["x"].by_element
    assert negated[4] < 0.01
    assert min(negated[1], negated[3], negated[5]) > 0.3


def test_gains_tell_signs_and_units():
    """They commute with every transform, so they are no contradiction."""
    states, actions = demonstrations()
    opposite = results(states, scaled(actions, 3, -1.0))["yaw"]
    assert opposite.gain == pytest.approx(-0.5, rel=0.01)
    millimetres = results(states, scaled(actions, 2, 1000.0))["z"]
    assert millimetres.gain == pytest.approx(0.0005, rel=0.01)
    assert not opposite.is_contradicted
    assert not millimetres.is_contradicted


def test_targets_are_explained_as_targets():
    states, actions = demonstrations()
    targets = [
        action + np.hstack([state[:, :4], np.zeros((len(state), 1))])
        for state, action in zip(states, actions, strict=True)
    ]
    as_targets, as_increments = (results(states, targets, mode=mode) for mode in ("absolute", "delta"))
    for label in ("x", "z", "yaw"):
        assert as_targets[label].explained > 0.99
        assert as_increments[label].explained < 0.5


def test_actions_that_do_not_move_the_state_say_nothing():
    states, _ = demonstrations()
    _, others = demonstrations(seed=1)
    found = results(states, others)
    assert not any(result.is_known or result.is_contradicted for result in found.values() if result.labels[0] == "x")


@pytest.mark.filterwarnings("error")
def test_a_dimension_that_moves_in_one_episode_is_left_out():
    states, actions = demonstrations(0.0)
    for state, action in zip(states[1:], actions[1:], strict=True):
        state[:, 2], action[:, 2] = 0.1, 0.0
    found = results(states, actions)
    assert "z" not in found
    assert found["x"].explained > 0.8


def test_dimensions_that_always_move_alike_contradict_nothing():
    """Demonstrations along one diagonal: x and y cannot be told apart."""
    states, actions = demonstrations()
    for vectors in (states, actions):
        for values in vectors:
            values[:, 1] = values[:, 0]
    found = results(states, actions)
    assert found["x"].explained > 0.9
    assert not found["x"].is_contradicted


def test_the_yaw_of_a_gripper_that_turns_over_is_followed():
    states, actions = demonstrations(gain=20.0)
    assert max(np.abs(np.diff(state[:, 3])).max() for state in states) > 2  # it wraps
    assert results(states, actions, window=1)["yaw"].explained > 0.99


def test_too_few_or_too_short_episodes_are_refused():
    states, actions = demonstrations(episodes=LEAST_EPISODES - 1)
    with pytest.raises(ValueError, match=f"needs {LEAST_EPISODES} episodes, got {LEAST_EPISODES - 1}"):
        results(states, actions)
    with pytest.raises(ValueError, match="no episode has more than 100 frames"):
        results(states, actions, window=100)
