import numpy as np
import pytest

from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.workspace import Workspace


def test_pixel_centres_lie_half_a_pixel_inside_the_border(workspace):
    np.testing.assert_allclose(workspace.xy_from_pixel(np.array([0, 0]), 4), [0.25 + 0.05, -0.2 + 0.05])
    np.testing.assert_allclose(workspace.pixel_from_xy(np.array([0.45, 0.0]), 4), [1.5, 1.5])


def test_pixel_from_xy_and_xy_from_pixel_are_inverse(workspace):
    xy = np.random.default_rng(0).uniform(-1, 1, size=(7, 2))
    np.testing.assert_allclose(workspace.xy_from_pixel(workspace.pixel_from_xy(xy, 152), 152), xy, atol=1e-12)


def test_rows_grow_with_x_and_columns_with_y(workspace):
    row, column = workspace.pixel_from_xy(np.array([0.55, 0.05]), 152)
    assert row > column > 75.5


def test_a_workspace_of_size_zero_is_rejected():
    with pytest.raises(OptionError, match="positive"):
        Workspace(size=0.0)
