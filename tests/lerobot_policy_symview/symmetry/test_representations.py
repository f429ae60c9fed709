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


def transform(angle=0.0, reflected=False):
    return PlanarTransform(torch.tensor([angle], dtype=torch.float64), torch.tensor([reflected]))


def test_quarter_turn_maps_x_to_y_and_y_to_minus_x():
    transformed = OTHER.transform(VALUES, transform(math.pi / 2), absolute_yaw=True)
    torch.testing.assert_close(transformed[0], VALUES.new_tensor([0.5, 0.1, 0.3 + math.pi / 2, -0.2, 0.7]))


def test_rotation_keeps_yaw_increments():
    assert OTHER.transform(VALUES, transform(1.0), absolute_yaw=False)[0, 2] == VALUES[0, 2]


def test_reflection_negates_y_and_yaw():
    transformed = OTHER.transform(VALUES, transform(reflected=True), absolute_yaw=True)
    torch.testing.assert_close(transformed[0], VALUES.new_tensor([0.5, -0.2, -0.3, 0.1, 0.7]))


def test_reflection_is_applied_before_the_rotation():
    transformed = OTHER.transform(VALUES, transform(math.pi / 2, reflected=True), absolute_yaw=True)
    torch.testing.assert_close(transformed[0], VALUES.new_tensor([0.5, 0.1, -0.3 + math.pi / 2, 0.2, 0.7]))


def test_rotation_vectors_transform_as_rotations_do():
    """A transform M maps the rotation R(v) to M R(v) M^T, whose rotation vector the representation predicts."""
    rotation_vector = np.array([0.3, -0.2, 0.5])

    def matrix(v):
        cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
        return torch.linalg.matrix_exp(torch.tensor(cross)).numpy()

    for reflected in (False, True):
        angle = 0.7
        orthogonal = np.array(
            [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
        )
        orthogonal = orthogonal @ np.diag([1, -1 if reflected else 1, 1])
        action = torch.tensor([[0, 0, 0, *rotation_vector, 0]])
        transformed = END_EFFECTOR.transform(action, transform(angle, reflected), absolute_yaw=False)[0, 3:6].numpy()
        np.testing.assert_allclose(matrix(transformed), orthogonal @ matrix(rotation_vector) @ orthogonal.T, atol=1e-12)


@pytest.mark.parametrize("symmetry", [OTHER, END_EFFECTOR, TWO_ARMS], ids=lambda s: "-".join(s.dimensions))
@pytest.mark.parametrize("name", ["D4", "C8"])
def test_matrices_match_the_transform_of_vectors(symmetry, name):
    group = make_group(name)
    values = torch.rand(1, len(symmetry.dimensions), dtype=torch.float64)
    for element, matrix in enumerate(symmetry.matrices(group)):
        transformed = symmetry.transform(values, PlanarTransform.of_element(group, element, values), absolute_yaw=False)
        torch.testing.assert_close(transformed[0], torch.tensor(matrix) @ values[0])


def test_trivial_theta_keeps_yaw_but_negates_other_signs():
    matrices = VectorRepresentation(("yaw", "sign")).matrices(make_group("D4"), "trivial")
    np.testing.assert_array_equal(matrices[4], [[1, 0], [0, -1]])


def test_the_dimensions_of_a_vector_share_a_centred_scale():
    minimum = torch.tensor([0.0, -0.01, -0.2, -0.05, 0.1])
    maximum = torch.tensor([1.0, 0.03, 0.1, 0.02, 0.1])
    center, width = OTHER.scale(minimum, maximum)
    torch.testing.assert_close(center, torch.tensor([0.5, 0.0, 0.0, 0.0, 0.1]))
    torch.testing.assert_close(width, torch.tensor([0.5, 0.05, 0.2, 0.05, 1.0]))


@pytest.mark.parametrize(
    ("dimensions", "message"),
    [
        (("x", "y", "height"), "unknown types .*height"),
        (("x", "scalar"), "needs both 'x' and 'y'"),
        (("x:left", "y:right", "y:left"), "needs both 'y:right' and 'x:right'"),
        (("x", "y", "x"), "more than once.*'x:left'"),
    ],
)
def test_wrong_declaration_error_names_the_flag(dimensions, message):
    with pytest.raises(ValueError, match=f"--policy.action_symmetry.*{message}"):
        VectorRepresentation(dimensions, "--policy.action_symmetry")


def test_wrong_size_error_lists_the_features_dimension_names():
    with pytest.raises(ValueError, match=r"describes 2 dimensions.*'action' has 3 \(dx, dy, dz\).*action_symmetry="):
        VectorRepresentation(("x", "y"), "--policy.action_symmetry").check(3, "action", ["dx", "dy", "dz"])


@pytest.mark.parametrize(
    ("dimensions", "names", "wrong"),
    [
        (("x", "y", "z"), ["dx", "dz", "dy"], "'dz' as 'y', 'dy' as 'z'"),
        (("x:left", "y:left", "yaw"), ["y", "x", "yaw"], "'y' as 'x:left', 'x' as 'y:left'"),
        (("aperture", "sign", "sign"), ["scalar", "yaw", "rx"], "'yaw' as 'sign', 'rx' as 'sign'"),
    ],
)
def test_types_that_contradict_dimension_names_raise(dimensions, names, wrong):
    with pytest.raises(ValueError, match=f"action_symmetry declares {wrong}: 'action' is {', '.join(names)}"):
        VectorRepresentation(dimensions, "--policy.action_symmetry").check(len(dimensions), "action", names)


@pytest.mark.parametrize(
    ("dimensions", "names"),
    [
        (("x", "y", "scalar"), ["dx", "dy", "dyaw"]),
        (("yaw:arm", "z", "aperture"), ["dyaw", "aperture", "dz"]),
        (("x", "y", "z"), ["px", "py", "depth"]),
        (("x", "y"), None),
    ],
)
def test_types_that_agree_with_dimension_names_are_accepted(dimensions, names):
    VectorRepresentation(dimensions).check(len(dimensions), "action", names)
