import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_symview.geometry.upsampling import MAX_STEP, enlarge_depth
from tests.helpers.cameras import cameras, make_camera, plane_depth


@pytest.mark.parametrize("factor", [1, 2, 3, 5])
@given(camera=cameras())
def test_planes_are_interpolated_exactly(factor, camera):
    """Exact where neighbouring depths differ little; at larger steps, as at the horizon, depths are repeated."""
    depth = plane_depth(camera)
    enlarged = enlarge_depth(depth, factor)
    exact = plane_depth(camera.resized(factor * camera.height, factor * camera.width))
    inner = slice(factor, -factor)  # the border would need extrapolation by half a pixel
    repeated = depth.repeat(factor, axis=0).repeat(factor, axis=1)
    interpolated = np.isclose(enlarged, exact, rtol=1e-5)
    kept = np.isclose(enlarged, repeated, rtol=1e-6)
    assert (interpolated | kept)[inner, inner].all()
    steps = [np.abs(np.diff(depth, axis=axis, append=np.inf)) for axis in (0, 1)]
    smooth = (np.maximum(*steps) < MAX_STEP / 4 * depth).repeat(factor, axis=0).repeat(factor, axis=1)
    smooth &= np.roll(smooth, (factor, factor), axis=(0, 1))
    assert interpolated[inner, inner][smooth[inner, inner]].all()


def test_depth_steps_are_not_interpolated():
    depth = np.where(np.arange(8) < 4, 0.8, 0.9)[None].repeat(6, axis=0)
    assert set(np.unique(enlarge_depth(depth, 3))) == {np.float32(0.8), np.float32(0.9)}


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_invalid_pixels_stay_invalid_in_place(bad):
    depth = np.full((5, 5), 0.8)
    depth[2, 2] = bad
    enlarged = enlarge_depth(depth, 4)
    assert (enlarged[8:12, 8:12] == 0).all()
    assert (enlarged == 0).sum() == 16
    np.testing.assert_allclose(enlarged[enlarged > 0], 0.8, rtol=1e-6)


@given(rows=st.integers(1, 4), columns=st.integers(1, 4), factor=st.integers(1, 4))
def test_images_of_any_size_are_upsampled(rows, columns, factor):
    np.testing.assert_allclose(enlarge_depth(np.full((rows, columns), 0.5), factor), 0.5)


def test_the_enlarged_camera_has_the_same_field_of_view():
    camera = make_camera(size=10)
    big = camera.resized(3 * camera.height, 3 * camera.width)
    # the image's edges, half a pixel outside the centres of the border pixels, do not move
    for small_edge, big_edge in ((-0.5, -0.5), (9.5, 29.5)):
        here = (small_edge - camera.intrinsics[0, 2]) / camera.intrinsics[0, 0]
        there = (big_edge - big.intrinsics[0, 2]) / big.intrinsics[0, 0]
        assert there == pytest.approx(here)
