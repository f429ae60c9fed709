import numpy as np
import pytest
import torch

from lerobot_symview.geometry.gripper_state import gripper_columns, missing_of, poses_from_states

STATES = np.array([[0.1, 0.2, 0.3, 0.4], [0.5, 0.6, 0.7, 0.8]])


@pytest.mark.parametrize(
    ("names", "columns"),
    [
        (["x", "y", "z", "yaw", "aperture"], [0, 1, 2, 3, 4]),
        (["aperture", "z", "y", "x"], [3, 2, 1, None, 0]),
        (["force", "x", "y", "z"], [1, 2, 3, None, None]),
        (["x", "y", "yaw", "aperture"], None),
        ([], None),
    ],
)
def test_the_gripper_is_known_with_its_position(names, columns):
    assert gripper_columns(names) == columns
    assert (missing_of(names) == "") == (columns is not None)


def test_without_its_yaw_a_gripper_that_turns_is_unknown():
    assert gripper_columns(["x", "y", "z", "aperture"], turns=True) is None
    assert missing_of(["x", "y", "aperture"], turns=True) == "z, yaw"
    assert gripper_columns(["x", "y", "z", "yaw"], turns=True) == [0, 1, 2, 3, None]


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy], ids=["numpy", "torch"])
def test_a_hand_without_yaw_never_turns_and_one_without_aperture_is_open(kind):
    poses = poses_from_states(kind(STATES), [3, 2, 1, None, None])
    assert type(poses) is type(kind(STATES))
    np.testing.assert_array_equal(np.asarray(poses), [[0.4, 0.3, 0.2, 0.0, 1.0], [0.8, 0.7, 0.6, 0.0, 1.0]])
