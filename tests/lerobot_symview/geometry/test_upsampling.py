import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_symview.geometry.upsampling import MAX_STEP, enlarge_depth
from tests.conftest import make_camera
from tests.lerobot_symview.cameras import cameras


def plane_depth(camera, height=0.0):
    """Depth of the plane at `height` seen by `camera`, 0 where it does not see it."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
    downwards = (rays @ camera.world_from_cam[:3, :3].T)[..., 2]
    with np.errstate(divide="ignore"):
        depth = (height - camera.position[2]) / downwards
    return np.where((downwards < 0) & (depth < 100), depth, 0.0)


@pytest.mark.parametrize("factor", [1, 2, 3, 5])
@given(camera=cameras())
def test_planes_are_interpolated_exactly(factor, camera):
    """Wherever neighbours differ by little, that is: elsewhere, as beyond the horizon, the pixel's own depth stays."""
    depth = plane_depth(camera)
    enlarged = enlarge_depth(depth, factor)
    exact = plane_depth(camera.enlarged(factor))
    inner = slice(factor, -factor)  # half a pixel at the border would have to be extrapolated
    repeated = depth.repeat(factor, axis=0).repeat(factor, axis=1)
    interpolated = np.isclose(enlarged, exact, rtol=1e-5)
    kept = np.isclose(enlarged, repeated, rtol=1e-6)
    assert (interpolated | kept)[inner, inner].all()
    steps = [np.abs(np.diff(depth, axis=axis, append=np.inf)) for axis in (0, 1)]
    smooth = (np.maximum(*steps) < MAX_STEP / 4 * depth).repeat(factor, axis=0).repeat(factor, axis=1)
    smooth &= np.roll(smooth, (factor, factor), axis=(0, 1))
    assert interpolated[inner, inner][smooth[inner, inner]].all()


def test_a_step_stays_a_step():
    depth = np.where(np.arange(8) < 4, 0.8, 0.9)[None].repeat(6, axis=0)
    assert set(np.unique(enlarge_depth(depth, 3))) == {np.float32(0.8), np.float32(0.9)}


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_invalid_depth_stays_invalid_and_where_it_was(bad):
    depth = np.full((5, 5), 0.8)
    depth[2, 2] = bad
    enlarged = enlarge_depth(depth, 4)
    assert (enlarged[8:12, 8:12] == 0).all()
    assert (enlarged == 0).sum() == 16
    np.testing.assert_allclose(enlarged[enlarged > 0], 0.8, rtol=1e-6)


@given(rows=st.integers(1, 4), columns=st.integers(1, 4), factor=st.integers(1, 4))
def test_images_of_any_size_are_enlarged(rows, columns, factor):
    np.testing.assert_allclose(enlarge_depth(np.full((rows, columns), 0.5), factor), 0.5)


def test_the_enlarged_camera_sees_the_same_field():
    camera = make_camera(size=10)
    big = camera.enlarged(3)
    # edges of the image, half a pixel outside its border pixels, stay where they were
    for small_edge, big_edge in ((-0.5, -0.5), (9.5, 29.5)):
        here = (small_edge - camera.intrinsics[0, 2]) / camera.intrinsics[0, 0]
        there = (big_edge - big.intrinsics[0, 2]) / big.intrinsics[0, 0]
        assert there == pytest.approx(here)
