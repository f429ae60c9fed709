import numpy as np
import pytest
from hypothesis import given
from scipy import ndimage

from lerobot_symview.geometry.infill import fill_local, nearest_known
from tests.helpers.cameras import MASKS


def slow_nearest(known):
    """Brute-force reference; ties go to the leftmost column, then to the uppermost row."""
    candidates = sorted(map(tuple, np.argwhere(known)), key=lambda pixel: (pixel[1], pixel[0]))
    nearest = np.empty(known.shape, dtype=np.int64)
    for r in range(known.shape[0]):
        for c in range(known.shape[1]):
            row, column = min(candidates, key=lambda pixel: (pixel[0] - r) ** 2 + (pixel[1] - c) ** 2)
            nearest[r, c] = row * known.shape[1] + column
    return nearest


@given(known=MASKS)
def test_nearest_known_equals_the_reference_including_ties(known):
    expected = slow_nearest(known) if known.any() else np.full(known.shape, -1)
    np.testing.assert_array_equal(nearest_known(known), expected)


def distances(known):
    rows, columns = np.divmod(nearest_known(known), known.shape[1])
    return np.hypot(rows - np.arange(known.shape[0])[:, None], columns - np.arange(known.shape[1]))


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
@given(known=MASKS.filter(np.any))
def test_rotating_the_mask_rotates_the_distances(quarter_turns, known):
    rotated = distances(np.ascontiguousarray(np.rot90(known, quarter_turns)))
    np.testing.assert_allclose(rotated, np.rot90(distances(known), quarter_turns), atol=1e-12)


def test_distances_in_a_large_image_equal_scipys():
    known = np.random.default_rng(0).random((300, 200)) < 0.001
    np.testing.assert_allclose(distances(known), ndimage.distance_transform_edt(~known), atol=1e-9)


def test_fill_local_averages_the_window_and_keeps_large_holes():
    image = np.zeros((20, 20), dtype=np.float32)
    known = np.zeros((20, 20), dtype=bool)
    image[2, 2], image[2, 4] = 1.0, 3.0
    known[2, 2] = known[2, 4] = True
    filled = fill_local(image, known)
    assert filled[2, 3] == pytest.approx(2.0)
    assert filled[2, 0] == pytest.approx(1.0)
    assert filled[15, 15] == 0.0
    assert (filled[known] == image[known]).all()


def test_fill_local_treats_channels_independently_and_rounds():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (12, 12, 3), dtype=np.uint8)
    known = rng.random((12, 12)) < 0.3
    filled = fill_local(image, known)
    for channel in range(3):
        expected = fill_local(image[..., channel].astype(np.float32), known)
        assert np.abs(filled[..., channel] - expected).max() <= 0.5
    np.testing.assert_array_equal(filled[known], image[known])
