"""A camera that cannot be right is rejected, and the error names the reading of its pose that would be."""

import numpy as np
import pytest

from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera, invert_rigid, orbit_pose
from lerobot_symview.geometry.visibility import (
    AXES,
    camera_problem,
    check_camera,
    detail,
    read_differently,
    sound_readings,
    workspace_pixels,
)
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import Frame
from tests.helpers.cameras import make_camera

WORKSPACE = Workspace()


def with_pose(pose):
    camera = make_camera(size=96)
    return Camera(camera.intrinsics, pose, 96, 96)


def scaled(pose, factor):
    changed = pose.copy()
    changed[:3, 3] *= factor
    return changed


POSE = make_camera(50, 30).world_from_cam
GL = np.eye(4)
GL[:3, :3] = AXES["OpenGL axes (y up, z backward)"]


@pytest.mark.parametrize("elevation", [20, 45, 80, 90])
@pytest.mark.parametrize("azimuth", [-120, 0, 75])
def test_cameras_that_see_the_workspace_have_no_problem(elevation, azimuth):
    assert camera_problem(make_camera(elevation, azimuth), WORKSPACE) is None


@pytest.mark.parametrize(
    ("pose", "reading"),
    [
        (invert_rigid(POSE), "the direction cam_from_world"),
        (scaled(POSE, 1000), "a position in millimetres"),
        (scaled(POSE, 0.001), "a position in metres"),
        (POSE @ GL, "OpenGL axes (y up, z backward)"),
        (invert_rigid(POSE @ GL), "the direction cam_from_world and OpenGL axes (y up, z backward)"),
    ],
)
def test_the_reading_that_the_camera_would_be_sound_with_is_named(pose, reading):
    assert reading in sound_readings(with_pose(pose), WORKSPACE)
    with pytest.raises(CalibrationError, match=r"camera 'front' .*it would see the workspace with "):
        check_camera("front", with_pose(pose), WORKSPACE)


def test_every_reading_undoes_itself():
    """The reading of a pose that was written in that reading is the true pose."""
    true = with_pose(POSE)
    for name, read in read_differently(true).items():
        written = read_differently(read)
        if name in [("the direction cam_from_world",), ("OpenGL axes (y up, z backward)",)]:
            np.testing.assert_allclose(written[name].world_from_cam, POSE, atol=1e-12)


def test_a_camera_below_the_table_is_rejected_with_its_usual_causes():
    below = with_pose(np.diag([1.0, -1.0, -1.0, 1.0]) @ POSE)
    with pytest.raises(CalibrationError, match=r"is below the table, at z = -0\.\d+ m.*clockwise.*cam_from_world"):
        check_camera("front", below, WORKSPACE)
    with pytest.raises(CalibrationError, match="below the table"):
        Frame(np.zeros((96, 96, 3), np.uint8), None, below, WORKSPACE)


def test_a_workspace_of_less_than_eight_pixels_is_rejected():
    pose = make_camera(50, 30).world_from_cam.copy()
    pose[:3, 3] += 20 * (pose[:3, 3] - (0.45, 0.0, 0.0))
    assert workspace_pixels(with_pose(pose), WORKSPACE) < 8
    with pytest.raises(CalibrationError, match=r"in \d\.\d x \d\.\d pixels, expected at least 8; it is 17 m away"):
        check_camera("front", with_pose(pose), WORKSPACE)


def test_pixels_of_the_workspace_of_a_camera_above_it():
    """Known answer: 0.4 m at a distance of 0.81 m with a focal length of f pixels are 0.4 f / 0.81 pixels."""
    camera = make_camera(90)
    assert workspace_pixels(camera, WORKSPACE) == pytest.approx(0.4 * camera.fx / 0.81)


def test_the_detail_of_a_camera_above_the_workspace_is_the_same_everywhere():
    """152 pixels of 48 degrees at 0.81 m: 0.21 pixels a millimetre, 84 of 0.4 m."""
    assert detail("front", make_camera(90), WORKSPACE, {"reproj": 152, "persp": 76}) == (
        "camera 'front' has 0.21 pixels a millimetre on the table, at worst 0.21: "
        "it fills a view of 84 x 84 pixels, reproj has 152, persp has 76"
    )
    assert "at worst 0.11: it fills a view of 73 x 73 pixels" in detail("side", make_camera(45), WORKSPACE, {})


def test_a_camera_over_the_workspace_may_have_a_corner_of_it_behind():
    low = orbit_pose(np.deg2rad(20), 0.0, 0.15, (0.45, 0.0, 0.0))
    assert "has a corner of the workspace behind it" in detail("front", with_pose(low), WORKSPACE, {})
