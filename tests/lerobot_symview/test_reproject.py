import numpy as np
import pytest

from lerobot_symview.reproject import EMPTY, fill_local, fill_nearest, ordered_bits, zbuffer
from lerobot_symview.workspace import Workspace

SIZE = 8


def slow_zbuffer(points, valid, workspace, pixels):
    """The definition, point by point."""
    source = np.full((pixels, pixels), EMPTY)
    for i, (x, y, z) in enumerate(points):
        row = int(np.floor(pixels * ((x - workspace.center[0]) / workspace.size + 0.5)))
        column = int(np.floor(pixels * ((y - workspace.center[1]) / workspace.size + 0.5)))
        if valid[i] and 0 <= row < pixels and 0 <= column < pixels:
            best = source[row, column]
            if best == EMPTY or np.float32(z) > np.float32(points[best, 2]):
                source[row, column] = i
    return source


@pytest.fixture
def cloud():
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(0.2, 0.7, 400), rng.uniform(-0.25, 0.25, 400), rng.integers(-3, 4, 400) / 50])
    return points, rng.random(400) < 0.8


def test_zbuffer_equals_its_definition(cloud, workspace):
    points, valid = cloud
    expected = slow_zbuffer(points, valid, workspace, SIZE)
    assert (expected != EMPTY).any()
    np.testing.assert_array_equal(zbuffer(points, valid, workspace, SIZE), expected)


def test_the_highest_point_wins_and_the_first_of_equals(workspace):
    points = np.array([[0.45, 0.0, 0.1], [0.45, 0.0, 0.3], [0.45, 0.0, 0.3], [0.45, 0.0, -0.2]])
    source = zbuffer(points, np.ones(4, dtype=bool), workspace, 1)
    assert source.tolist() == [[1]]


def test_the_order_of_points_changes_nothing_but_their_indices(cloud, workspace):
    points, valid = cloud
    points[:, 2] += np.arange(len(points)) * 1e-5  # no ties
    order = np.random.default_rng(2).permutation(len(points))
    direct = zbuffer(points, valid, workspace, SIZE)
    shuffled = zbuffer(points[order], valid[order], workspace, SIZE)
    np.testing.assert_array_equal(np.where(shuffled == EMPTY, EMPTY, order[shuffled]), direct)


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_turning_the_points_turns_the_image(cloud, quarter_turns):
    workspace = Workspace(center=(0.0, 0.0))
    points, valid = cloud
    points[:, 0] -= 0.45
    angle = quarter_turns * np.pi / 2
    rotation = np.rint([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = np.column_stack([points[:, :2] @ rotation.T, points[:, 2]])
    expected = np.rot90(zbuffer(points, valid, workspace, SIZE), quarter_turns)
    np.testing.assert_array_equal(zbuffer(turned, valid, workspace, SIZE), expected)


def test_mirroring_the_points_mirrors_the_image(cloud):
    workspace = Workspace(center=(0.0, 0.0))
    points, valid = cloud
    mirrored = points * [1, -1, 1]
    expected = zbuffer(points, valid, workspace, SIZE)[:, ::-1]
    np.testing.assert_array_equal(zbuffer(mirrored, valid, workspace, SIZE), expected)


def test_no_points_give_an_empty_image(workspace):
    assert (zbuffer(np.zeros((0, 3)), np.zeros(0, dtype=bool), workspace, 4) == EMPTY).all()


def test_ordered_bits_keep_the_order_of_float32():
    values = np.array([-np.inf, -1.5, -1e-30, -0.0, 0.0, 1e-30, 0.3, 2.0, np.inf])
    bits = ordered_bits(values)
    assert (np.diff(bits.astype(np.int64)) >= 0).all()
    assert bits[3] == bits[4]
    assert bits.min() > 0
    assert bits.max() < 2**32


def test_fill_nearest_gives_each_pixel_a_nearest_source():
    rng = np.random.default_rng(0)
    source = np.where(rng.random((12, 12)) < 0.2, np.arange(144).reshape(12, 12), EMPTY)
    filled = fill_nearest(source)
    known = np.argwhere(source != EMPTY)
    for row, column in np.argwhere(source == EMPTY):
        best = np.linalg.norm(known - [row, column], axis=1).min()
        chosen = np.array(divmod(filled[row, column], 12))
        assert np.linalg.norm(chosen - [row, column]) == pytest.approx(best)
    np.testing.assert_array_equal(filled[source != EMPTY], source[source != EMPTY])


def test_fill_nearest_leaves_an_empty_map_empty():
    assert (fill_nearest(np.full((3, 3), EMPTY)) == EMPTY).all()


def test_fill_local_averages_the_neighbourhood_and_leaves_large_holes():
    image = np.zeros((20, 20), dtype=np.float32)
    known = np.zeros((20, 20), dtype=bool)
    image[2, 2], image[2, 4] = 1.0, 3.0
    known[2, 2] = known[2, 4] = True
    filled = fill_local(image, known)
    assert filled[2, 3] == pytest.approx(2.0)
    assert filled[2, 0] == pytest.approx(1.0)
    assert filled[15, 15] == 0.0
    assert (filled[known] == image[known]).all()
