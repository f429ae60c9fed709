import numpy as np
import pytest

from lerobot_symview.placement import CameraSpec, top_camera
from lerobot_symview.workspace import Workspace
from tests.conftest import make_camera


def test_pixel_centres_lie_half_a_pixel_inside_the_border(workspace):
    np.testing.assert_allclose(workspace.xy_from_pixel(np.array([0, 0]), 4), [0.25 + 0.05, -0.2 + 0.05])
    np.testing.assert_allclose(workspace.pixel_from_xy(np.array([0.45, 0.0]), 4), [1.5, 1.5])


def test_pixel_from_xy_and_xy_from_pixel_are_inverse(workspace):
    xy = np.random.default_rng(0).uniform(-1, 1, size=(7, 2))
    np.testing.assert_allclose(workspace.xy_from_pixel(workspace.pixel_from_xy(xy, 152), 152), xy, atol=1e-12)


def test_rows_grow_with_x_and_columns_with_y(workspace):
    row, column = workspace.pixel_from_xy(np.array([0.55, 0.05]), 152)
    assert row > column > 75.5


@pytest.mark.parametrize("elevation", [15, 30, 45, 60, 75])
def test_the_default_camera_sees_the_whole_working_volume(workspace, elevation):
    assert workspace.visible_fraction(make_camera(elevation)) == 1.0


def test_a_camera_that_looks_elsewhere_is_refused_with_the_fraction_it_sees(workspace):
    with pytest.raises(ValueError, match=r"sees \d+% of the workspace"):
        CameraSpec(fov_deg=8.0).place(workspace)


@pytest.mark.parametrize(
    "fields",
    [{"elevation_deg": 0.0}, {"elevation_deg": 91.0}, {"size": 2}, {"name": "my camera"}],
    ids=lambda f: str(f),
)
def test_impossible_placements_are_refused(fields):
    with pytest.raises(ValueError, match=next(iter(fields))):
        CameraSpec(**fields)


def test_the_oracle_frames_the_table_square_exactly(workspace):
    camera = top_camera(100, workspace).place(workspace)
    from lerobot_symview.camera import project

    pixels, _ = project(workspace.corners(), camera)
    np.testing.assert_allclose(pixels, [[-0.5, -0.5], [99.5, -0.5], [99.5, 99.5], [-0.5, 99.5]], atol=1e-6)


def test_a_workspace_without_extent_is_refused():
    with pytest.raises(ValueError, match="positive"):
        Workspace(size=0.0)
