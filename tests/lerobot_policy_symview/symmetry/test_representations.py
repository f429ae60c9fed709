import math

import numpy as np
import pytest
import torch

from lerobot_policy_symview.symmetry.groups import make_group
from lerobot_policy_symview.symmetry.representations import VectorRepresentation
from lerobot_policy_symview.symmetry.transforms import PlanarTransform

OTHER = VectorRepresentation(("aperture", "y", "yaw", "x", "z"))  # not the default order
VALUES = torch.tensor([[0.5, 0.2, 0.3, 0.1, 0.7]], dtype=torch.float64)
END_EFFECTOR = VectorRepresentation(("x", "y", "z", "rx", "ry", "yaw", "aperture"))
TWO_ARMS = VectorRepresentation(("x:left", "y:left", "x:right", "y:right", "sign", "sign", "scalar"))


def motion(angle=0.0, mirrored=False):
    return PlanarTransform(torch.tensor([angle], dtype=torch.float64), torch.tensor([mirrored]))


def test_a_quarter_turn_sends_x_to_y_and_y_to_minus_x():
    moved = OTHER.transform(VALUES, motion(math.pi / 2), absolute_yaw=True)
    torch.testing.assert_close(moved[0], VALUES.new_tensor([0.5, 0.1, 0.3 + math.pi / 2, -0.2, 0.7]))


def test_increments_of_yaw_do_not_turn_along():
    assert OTHER.transform(VALUES, motion(1.0), absolute_yaw=False)[0, 2] == VALUES[0, 2]


def test_a_mirror_changes_the_sign_of_y_and_yaw():
    moved = OTHER.transform(VALUES, motion(mirrored=True), absolute_yaw=True)
    torch.testing.assert_close(moved[0], VALUES.new_tensor([0.5, -0.2, -0.3, 0.1, 0.7]))


def test_a_mirror_comes_before_the_turn():
    moved = OTHER.transform(VALUES, motion(math.pi / 2, mirrored=True), absolute_yaw=True)
    torch.testing.assert_close(moved[0], VALUES.new_tensor([0.5, 0.1, -0.3 + math.pi / 2, 0.2, 0.7]))


def test_rotation_vectors_move_as_rotations_do():
    """The motion of a rotation R(v) is M R(v) M^T, whose rotation vector the declaration predicts."""
    rotation_vector = np.array([0.3, -0.2, 0.5])

    def matrix(v):
        cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
        return torch.linalg.matrix_exp(torch.tensor(cross)).numpy()

    for mirrored in (False, True):
        turn = 0.7
        orthogonal = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
        orthogonal = orthogonal @ np.diag([1, -1 if mirrored else 1, 1])
        action = torch.tensor([[0, 0, 0, *rotation_vector, 0]])
        moved = END_EFFECTOR.transform(action, motion(turn, mirrored), absolute_yaw=False)[0, 3:6].numpy()
        np.testing.assert_allclose(matrix(moved), orthogonal @ matrix(rotation_vector) @ orthogonal.T, atol=1e-12)


@pytest.mark.parametrize("symmetry", [OTHER, END_EFFECTOR, TWO_ARMS], ids=lambda s: "-".join(s.dimensions))
@pytest.mark.parametrize("name", ["D4", "C8"])
def test_representations_are_what_moving_does(symmetry, name):
    group = make_group(name)
    values = torch.rand(1, len(symmetry.dimensions), dtype=torch.float64)
    for element, matrix in enumerate(symmetry.matrices(group)):
        moved = symmetry.transform(values, PlanarTransform.of_element(group, element, values), absolute_yaw=False)
        torch.testing.assert_close(moved[0], torch.tensor(matrix) @ values[0])


def test_the_papers_text_leaves_yaw_alone_but_no_other_sign():
    matrices = VectorRepresentation(("yaw", "sign")).matrices(make_group("D4"), "trivial")
    np.testing.assert_array_equal(matrices[4], [[1, 0], [0, -1]])


def test_the_scale_of_vectors_is_shared_and_centred():
    minimum = torch.tensor([0.0, -0.01, -0.2, -0.05, 0.1])
    maximum = torch.tensor([1.0, 0.03, 0.1, 0.02, 0.1])
    center, width = OTHER.scale(minimum, maximum)
    torch.testing.assert_close(center, torch.tensor([0.5, 0.0, 0.0, 0.0, 0.1]))
    torch.testing.assert_close(width, torch.tensor([0.5, 0.05, 0.2, 0.05, 1.0]))


@pytest.mark.parametrize(
    ("kinds", "message"),
    [
        (("x", "y", "height"), "unknown types .*height"),
        (("x", "scalar"), "needs both 'x' and 'y'"),
        (("x:left", "y:right", "y:left"), "needs both 'y:right' and 'x:right'"),
        (("x", "y", "x"), "more than once.*'x:left'"),
    ],
)
def test_a_wrong_declaration_is_refused_by_its_flag(kinds, message):
    with pytest.raises(ValueError, match=f"--policy.action_symmetry.*{message}"):
        VectorRepresentation(kinds, "--policy.action_symmetry")


def test_a_declaration_of_another_size_is_refused_with_the_features_names():
    with pytest.raises(ValueError, match=r"describes 2 dimensions.*'action' has 3 \(dx, dy, dz\).*action_symmetry="):
        VectorRepresentation(("x", "y"), "--policy.action_symmetry").check(3, "action", ["dx", "dy", "dz"])


@pytest.mark.parametrize(
    ("kinds", "names", "wrong"),
    [
        (("x", "y", "z"), ["dx", "dz", "dy"], "'dz' as 'y', 'dy' as 'z'"),
        (("x:left", "y:left", "yaw"), ["y", "x", "yaw"], "'y' as 'x:left', 'x' as 'y:left'"),
        (("aperture", "sign", "sign"), ["scalar", "yaw", "rx"], "'yaw' as 'sign', 'rx' as 'sign'"),
    ],
)
def test_kinds_that_contradict_the_features_names_are_refused(kinds, names, wrong):
    with pytest.raises(ValueError, match=f"action_symmetry declares {wrong}: 'action' is {', '.join(names)}"):
        VectorRepresentation(kinds, "--policy.action_symmetry").check(len(kinds), "action", names)


@pytest.mark.parametrize(
    ("kinds", "names"),
    [
        (("x", "y", "scalar"), ["dx", "dy", "dyaw"]),
        (("yaw:arm", "z", "aperture"), ["dyaw", "aperture", "dz"]),
        (("x", "y", "z"), ["px", "py", "depth"]),
        (("x", "y"), None),
    ],
)
def test_kinds_that_can_be_what_the_names_say_are_accepted(kinds, names):
    VectorRepresentation(kinds).check(len(kinds), "action", names)
