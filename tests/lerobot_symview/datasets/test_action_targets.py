"""Relative actions and their absolute targets."""

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset

from lerobot_symview import keys
from lerobot_symview.datasets.action_targets import absolute_targets
from lerobot_symview.errors import DatasetError
from lerobot_symview.geometry.placement import CameraSpec
from symview_sim.demonstration import demonstrate
from symview_sim.settings import EnvSettings


def test_increments_are_added_by_name_and_the_aperture_is_a_target():
    states = np.array([[0.1, -0.2, 0.05, 1.5, 0.7], [0.0, 0.0, 0.1, -1.5, 1.0]], np.float32)
    actions = np.array([[0.01, 0.02, -0.03, 0.2, 0.0], [0.0, 0.0, 0.0, -0.2, 0.5]], np.float32)
    targets = absolute_targets(states, actions, keys.STATE_NAMES, keys.ACTION_NAMES)
    expected = [[0.11, -0.18, 0.02, 1.7 - np.pi, 0.0], [0.0, 0.0, 0.1, np.pi - 1.7, 0.5]]
    np.testing.assert_allclose(targets, expected, atol=1e-6)
    assert targets.dtype == np.float32
    turnless = absolute_targets(states[:, [0, 4]], actions[:, [0, 4]], ["x", "aperture"], ["dx", "aperture"])
    np.testing.assert_allclose(turnless, np.array(expected)[:, [0, 4]], atol=1e-6)


def test_an_increment_of_what_the_state_lacks_is_an_error():
    with pytest.raises(DatasetError, match="'dyaw' increases 'yaw', the state has x"):
        absolute_targets(np.zeros(1), np.zeros(1), ["x"], ["dyaw"])


def test_a_recording_says_that_its_actions_are_relative_and_moves_to_their_targets(recorded):
    dataset = LeRobotDataset("test/recorded", root=recorded)
    assert dataset.meta.features[keys.ACTION]["info"]["symview"] == {"relative_to": keys.STATE}
    table = dataset.hf_dataset.with_format("numpy")
    same = table["episode_index"][1:] == table["episode_index"][:-1]
    assert_reached(np.array(table[keys.STATE][:]), np.array(table[keys.ACTION][:]), np.array(same))


@pytest.mark.parametrize("style", ["planner", "human"])
def test_fine_actions_move_the_gripper_to_their_targets(style):
    env = EnvSettings(control="fine", style=style, camera=CameraSpec(height=8, width=8), depth=False)
    frames = demonstrate(env, 0, 0, 0.0).frames
    assert_reached(frames[keys.STATE], frames[keys.ACTION], np.full(len(frames[keys.ACTION]) - 1, True))


def assert_reached(states, actions, same):
    """The next state is the target, except for the fingers, which the cube stops, and the height of a heavy hand."""
    targets = absolute_targets(states, actions, keys.STATE_NAMES, keys.ACTION_NAMES)
    errors = np.abs(targets[:-1] - states[1:])[same]
    errors[:, 3] = np.minimum(errors[:, 3], np.pi - errors[:, 3])
    assert errors[:, :3].max() < 0.005
    assert errors[:, 3].max() < 0.05
    np.testing.assert_array_equal(targets[:, 4], actions[:, 4])
    assert np.abs(actions[:-1, :3])[same].max() > 0.005  # it did move
