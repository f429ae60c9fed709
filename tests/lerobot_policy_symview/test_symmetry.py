import math

import pytest
import torch

from lerobot_policy_symview.symmetry import check_declaration, mirror, symmetric_range, turn

KINDS = ["aperture", "y", "yaw", "x", "z"]  # not the default order
VALUES = torch.tensor([[0.5, 0.2, 0.3, 0.1, 0.7]], dtype=torch.float64)


def test_a_quarter_turn_sends_x_to_y_and_y_to_minus_x():
    turned = turn(VALUES, KINDS, torch.tensor([math.pi / 2], dtype=torch.float64), absolute_yaw=True)
    torch.testing.assert_close(turned[0], VALUES.new_tensor([0.5, 0.1, 0.3 + math.pi / 2, -0.2, 0.7]))


def test_increments_of_yaw_do_not_turn_along():
    turned = turn(VALUES, KINDS, torch.tensor([1.0], dtype=torch.float64), absolute_yaw=False)
    assert turned[0, 2] == VALUES[0, 2]


def test_a_mirror_changes_the_sign_of_y_and_yaw():
    torch.testing.assert_close(mirror(VALUES, KINDS)[0], VALUES.new_tensor([0.5, -0.2, -0.3, 0.1, 0.7]))


def test_the_range_of_vectors_is_shared_and_centred():
    minimum = torch.tensor([0.0, -0.01, -0.2, -0.05, 0.1])
    maximum = torch.tensor([1.0, 0.03, 0.1, 0.02, 0.1])
    center, width = symmetric_range(minimum, maximum, KINDS)
    torch.testing.assert_close(center, torch.tensor([0.5, 0.0, 0.0, 0.0, 0.1]))
    torch.testing.assert_close(width, torch.tensor([0.5, 0.05, 0.2, 0.05, 1.0]))


@pytest.mark.parametrize(
    ("kinds", "size", "message"),
    [
        (["x", "y", "height"], None, "unknown kinds .*height"),
        (["x", "scalar"], None, "needs both 'x' and 'y'"),
        (["x", "y", "x"], None, "more than once"),
        (["x", "y", "z"], 5, "describes 3 entries, the dataset has 5"),
    ],
)
def test_a_wrong_declaration_is_refused_by_its_flag(kinds, size, message):
    with pytest.raises(ValueError, match=f"--policy.action_symmetry.*{message}"):
        check_declaration("action_symmetry", kinds, size)
