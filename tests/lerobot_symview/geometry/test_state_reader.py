import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from lerobot_symview.geometry.state_reader import END_EFFECTOR, StateReader, heading, origin_of
from lerobot_symview.geometry.workspace import Workspace

WORKSPACE = Workspace((0.3, -0.1), 0.5)
OURS = ("x", "y", "z", "yaw", "aperture")


def end_effector(yaw, rng, count):
    """States of a gripper that points down, turned by `yaw` (count,), in LeRobot's names with two more dimensions."""
    down = Rotation.from_euler("z", yaw[:, None]) * Rotation.from_euler("x", [180], degrees=True)
    position, opening = rng.uniform(-0.3, 0.3, (count, 3)), rng.uniform(0, 100, (count, 1))
    more = rng.normal(size=(count, 2))
    names = ("force", *END_EFFECTOR, "time")
    return names, np.hstack([more[:, :1], position, down.as_rotvec(), opening, more[:, 1:]]), position


def test_an_end_effectors_pose_is_read_as_ours():
    rng = np.random.default_rng(0)
    yaw = rng.uniform(-3, 3, 50)
    names, states, position = end_effector(yaw, rng, 50)
    reader = StateReader(names, origin_of(None, names, WORKSPACE, origin_height=0.02))
    read = reader.read(states)
    assert reader.converts
    assert reader.read_names == [*OURS, "force", "time"]
    np.testing.assert_allclose(read[:, :3], position - [0.3, -0.1, -0.02], atol=1e-12)
    np.testing.assert_allclose(read[:, 3], yaw, atol=1e-7)
    np.testing.assert_allclose(read[:, 4], states[:, 7] / 100)
    np.testing.assert_array_equal(read[:, 5:], states[:, [0, 8]])


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-5, 1.0, 3.1])
def test_the_heading_is_that_of_the_rotated_x_axis(scale):
    vectors = Rotation.random(200, random_state=1).as_rotvec()
    vectors *= scale / np.linalg.norm(vectors, axis=-1, keepdims=True)
    x, y, _ = Rotation.from_rotvec(vectors).as_matrix()[..., 0].T
    np.testing.assert_allclose(heading(*vectors.T), np.arctan2(y, x), atol=1e-9)


def test_numpy_and_torch_read_the_same_bits():
    rng = np.random.default_rng(2)
    names, states, _ = end_effector(rng.uniform(-3, 3, 500), rng, 500)
    reader, states = StateReader(names, (0.1, 0.2, 0.3)), states.astype(np.float32)
    read = reader.read(states)
    assert read.dtype == np.float32
    np.testing.assert_array_equal(reader.read(torch.from_numpy(states)).numpy(), read)


@pytest.mark.parametrize(
    ("kind", "names", "origin"),
    [
        (None, OURS, (0.0, 0.0, 0.0)),
        ("workspace", END_EFFECTOR, (0.0, 0.0, 0.0)),
        ("world", OURS, (0.3, -0.1, -0.05)),
        ("base", OURS, (0.3, -0.1, -0.05)),
        (None, END_EFFECTOR, (0.3, -0.1, -0.05)),
    ],
)
def test_positions_count_from_the_stated_origin(kind, names, origin):
    assert origin_of(kind, names, WORKSPACE, origin_height=0.05) == pytest.approx(origin)
    reader = StateReader(("z", "y", "x", "force"), origin)
    read = reader.read(np.array([[1.0, 2.0, 3.0, 4.0]]))
    np.testing.assert_allclose(read, [[1 - origin[2], 2 - origin[1], 3 - origin[0], 4.0]])
    assert reader.converts == any(origin)


def test_ranges_follow_the_dimensions():
    reader = StateReader(("force", *END_EFFECTOR))
    assert reader.read_range(np.arange(8.0)).tolist() == [0, 0, 0, 0, 0, 0.0]
    assert reader.read_range(np.arange(5.0, 13.0)).tolist() == [0, 0, 0, 0, 0, 5.0]
    assert StateReader(OURS).read_range(np.arange(5)).tolist() == [0, 1, 2, 3, 4]
