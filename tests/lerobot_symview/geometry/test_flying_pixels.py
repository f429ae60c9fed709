import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_symview.geometry.flying_pixels import without_flying_pixels
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import Frame, make_view
from tests.helpers.cameras import make_camera, plane_depth, random_depth

LIMIT = 0.02


def slow_flying(depth, limit):
    """Reference implementation, by the definition."""
    flying = np.zeros(depth.shape, dtype=bool)
    for (v, u), here in np.ndenumerate(depth.astype(float)):
        for first, second in (((v, u - 1), (v, u + 1)), ((v - 1, u), (v + 1, u))):
            if min(first) < 0 or second[0] >= depth.shape[0] or second[1] >= depth.shape[1]:
                continue
            near, far = sorted((float(depth[first]), float(depth[second])))
            flying[v, u] |= bool(near > 0 and np.isfinite(far) and here - near > limit and far - here > limit)
    return flying


@given(seed=st.integers(0, 2**32 - 1))
def test_flying_pixels_are_those_of_the_definition(seed):
    depth = random_depth(seed)
    expected = np.where(slow_flying(depth, LIMIT), 0, depth)
    np.testing.assert_array_equal(without_flying_pixels(depth, LIMIT), expected)


def test_pixels_between_two_surfaces_are_removed_and_the_surfaces_stay():
    depth = np.full((4, 9), 1.0, np.float32)
    depth[:, :3] = 0.7
    depth[:, 3], depth[:, 4] = 0.8, 0.9  # a step that two pixels blur
    result = without_flying_pixels(depth, LIMIT)
    assert (result[:, 3:5] == 0).all()
    np.testing.assert_array_equal(np.delete(result, [3, 4], axis=1), np.delete(depth, [3, 4], axis=1))


@pytest.mark.parametrize("move", [np.fliplr, np.flipud, np.transpose, np.rot90])
def test_flying_pixels_move_with_the_image(move):
    depth = random_depth(3)
    moved = without_flying_pixels(np.ascontiguousarray(move(depth)), LIMIT)
    np.testing.assert_array_equal(moved, move(without_flying_pixels(depth, LIMIT)))


def test_invalid_neighbours_and_sharp_edges_remove_nothing():
    depth = np.full((3, 6), 1.0, np.float32)
    depth[:, :3] = 0.7
    np.testing.assert_array_equal(without_flying_pixels(depth, LIMIT), depth)
    depth[:, 2:4] = [0.8, 0.9]
    for invalid in (0.0, np.nan, np.inf, -1.0):
        depth[:, 1], depth[:, 4] = invalid, invalid
        np.testing.assert_array_equal(without_flying_pixels(depth, LIMIT), depth)


@pytest.mark.parametrize("elevation", [45.0, 90.0])
def test_the_table_stays(elevation):
    depth = plane_depth(make_camera(elevation=elevation))
    np.testing.assert_array_equal(without_flying_pixels(depth, LIMIT), depth)


def test_a_view_without_flying_pixels_shows_no_smear_beside_a_box():
    """A depth camera averages over an object's edge: points hang in the air between its top and the table."""
    camera = make_camera(elevation=90.0)
    table, depth = plane_depth(camera), plane_depth(camera)
    depth[60:90, 60:90] = table[60:90, 60:90] - 0.1
    sharp, blurred = depth.astype(np.float32), depth.copy()
    for offset in (59, 90):
        blurred[60:90, offset] = table[60:90, offset] - 0.05
        blurred[offset, 60:90] = table[offset, 60:90] - 0.05
    rgb = np.zeros((*table.shape, 3), np.uint8)
    views = {
        (name, limit): make_view("reproj", clip="none", flying_limit=limit).render(
            Frame(rgb, image.astype(np.float32), camera, Workspace())
        )["reproj_height"]
        for name, image in (("sharp", sharp), ("blurred", blurred))
        for limit in (0.0, LIMIT)
    }
    hanging = {key: ((height > 0.02) & (height < 0.08)).sum() for key, height in views.items()}
    assert hanging["blurred", 0.0] > 100
    assert hanging["blurred", LIMIT] == hanging["sharp", 0.0] == 0
    np.testing.assert_array_equal(views["sharp", LIMIT], views["sharp", 0.0])
