import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_symview.geometry.gripper import GripperShape, gripper_image, gripper_image_uint8
from lerobot_symview.geometry.workspace import Workspace

STATE = np.array([0.06, -0.03, 0.1, 0.4, 0.7])


def test_fingers_have_the_gripper_height_and_opening(workspace):
    image = gripper_image(np.array([0.0, 0.0, 0.125, 0.0, 1.0]), workspace, 160)
    shape = GripperShape()
    assert image.max() == pytest.approx(0.5)  # half of the height limit
    area = image.sum() / 0.5 * (workspace.size / 160) ** 2
    assert area == pytest.approx(2 * shape.finger**2, rel=0.01)
    rows = np.flatnonzero(image.any(axis=1))  # at yaw 0 the fingers open along x, which is along rows
    assert (rows[-1] - rows[0] + 1) * workspace.size / 160 == pytest.approx(shape.opening + 2 * shape.finger, abs=0.006)
    assert image[80, 80] == 0


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_rotating_the_gripper_rotates_its_image(workspace, quarter_turns):
    angle = quarter_turns * np.pi / 2
    x, y, z, yaw, aperture = STATE
    rotated = np.array(
        [x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle), z, yaw + angle, aperture]
    )
    expected = np.rot90(gripper_image(STATE, workspace, 76), quarter_turns)
    np.testing.assert_allclose(gripper_image(rotated, workspace, 76), expected, atol=1e-12)


def test_reflecting_the_gripper_reflects_its_image(workspace):
    reflected = STATE * [1, -1, 1, -1, 1]
    expected = gripper_image(STATE, workspace, 76)[:, ::-1]
    np.testing.assert_allclose(gripper_image(reflected, workspace, 76), expected, atol=1e-12)


def test_yaw_is_periodic_in_half_a_turn(workspace):
    np.testing.assert_allclose(
        gripper_image(STATE + [0, 0, 0, np.pi, 0], workspace, 76), gripper_image(STATE, workspace, 76), atol=1e-12
    )


def test_torch_and_numpy_agree_and_batches_are_independent(workspace):
    states = np.stack([STATE, STATE * 0.5])
    batch = gripper_image(torch.from_numpy(states), workspace, 76)
    assert batch.shape == (2, 76, 76)
    np.testing.assert_allclose(batch[1].numpy(), gripper_image(states[1], workspace, 76), atol=1e-12)


def test_a_gripper_outside_the_workspace_is_not_drawn(workspace):
    assert gripper_image(STATE + [1, 0, 0, 0, 0], workspace, 76).max() == 0


POSITIONS = st.floats(-0.3, 0.3)


@given(x=POSITIONS, y=POSITIONS, z=st.floats(0, 0.4), yaw=st.floats(-4, 4), aperture=st.floats(0, 1))
def test_the_uint8_image_is_the_float_image_in_grey_levels(x, y, z, yaw, aperture):
    state = np.array([x, y, z, yaw, aperture])
    image = gripper_image(state, Workspace(), 76)
    np.testing.assert_array_equal(
        gripper_image_uint8(state, Workspace(), 76), np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)
    )
