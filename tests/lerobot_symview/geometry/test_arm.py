import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_symview.geometry.arm import without_arm
from lerobot_symview.geometry.camera import Camera, unproject
from lerobot_symview.geometry.lens import lens_from_coefficients
from lerobot_symview.geometry.workspace import Workspace
from tests.helpers.cameras import SHAPE, cameras, make_camera

WORKSPACE = Workspace()
LENS = lens_from_coefficients("plumb_bob", np.array([-0.1, 0.02, 0.001, 0.0, 0.0]))


def reference(depth, camera, gripper, radius, ceiling):
    """The same by points."""
    points = unproject(depth, camera)
    place = np.asarray(gripper[:2]) + WORKSPACE.center
    distance = np.linalg.norm(points[..., :2] - place, axis=-1)
    z = points[..., 2]
    gone = (z > WORKSPACE.height_limit) | ((z > ceiling) & (distance <= radius))
    return np.where(gone & (depth > 0), 0, depth)


@settings(deadline=None, max_examples=50)
@given(cameras(), st.integers(0, 2**31), st.booleans(), st.floats(0.01, 0.4), st.floats(0.0, 0.24))
def test_it_removes_what_is_over_the_gripper_or_the_working_volume(camera, seed, has_lens, radius, ceiling):
    rng = np.random.default_rng(seed)
    if has_lens and camera.fx > 40:
        camera = Camera(camera.intrinsics, camera.world_from_cam, *SHAPE, LENS)
    depth = rng.uniform(0.2, 1.6, SHAPE).astype(np.float32)
    depth[rng.uniform(size=SHAPE) < 0.1] = 0.0
    gripper = rng.uniform(-0.2, 0.2, size=5)
    before = depth.copy()
    kept = without_arm(depth, camera, WORKSPACE, gripper, radius, ceiling)
    np.testing.assert_array_equal(depth, before)
    assert kept.dtype == depth.dtype
    wrong = kept != reference(depth, camera, gripper, radius, ceiling)
    assert wrong.sum() <= 1  # a point within rounding of a border


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_invalid_depth_is_kept(bad):
    depth = np.full((16, 16), bad)
    kept = without_arm(depth, make_camera(size=16), WORKSPACE, np.zeros(5), 0.1, 0.1)
    np.testing.assert_array_equal(kept, depth)
