"""The table in a depth image decides the unit of depth and contradicts wrong calibrations."""

import numpy as np
import pytest

from lerobot_symview.calibration.table_plane import CAMERA_UNITS, check_table, has_depth, likely_depth_unit
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera, invert_rigid
from lerobot_symview.geometry.workspace import Workspace
from tests.helpers.cameras import make_camera, plane_depth

WORKSPACE = Workspace()
CAMERA = make_camera(45, 20)


def scene(camera=CAMERA, height=0.0, noise=0.0, seed=0):
    """Depth of a table with a block of 6 cm, sensor noise and a tenth of the pixels invalid."""
    rng = np.random.default_rng(seed)
    depth = plane_depth(camera, height)
    v, u = np.mgrid[: camera.height, : camera.width]
    block = (np.abs(v - 70) < 8) & (np.abs(u - 80) < 8)
    depth[block] = plane_depth(camera, height + 0.06)[block]
    depth += noise * rng.normal(size=depth.shape)
    depth[rng.random(depth.shape) < 0.1] = rng.choice([0.0, np.nan])
    return depth


def moved(shift=(0.0, 0.0, 0.0), tilt_deg=0.0):
    """The camera's pose with an error."""
    pose = CAMERA.world_from_cam.copy()
    c, s = np.cos(np.deg2rad(tilt_deg)), np.sin(np.deg2rad(tilt_deg))
    pose[:3, :3] = pose[:3, :3] @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    pose[:3, 3] += shift
    return Camera(CAMERA.intrinsics, pose, CAMERA.height, CAMERA.width)


@pytest.mark.parametrize("unit", CAMERA_UNITS)
@pytest.mark.parametrize("elevation", [20, 60, 90])
def test_the_table_tells_the_unit(unit, elevation):
    camera = make_camera(elevation)
    assert likely_depth_unit(scene(camera, noise=0.005) / unit, camera, WORKSPACE) == unit


def test_a_hidden_table_tells_no_unit():
    assert likely_depth_unit(np.full((152, 152), 0.1), CAMERA, WORKSPACE) is None
    assert likely_depth_unit(np.zeros((152, 152)), CAMERA, WORKSPACE) is None


@pytest.mark.parametrize("seed", range(5))
def test_a_right_calibration_passes_with_sensor_noise(seed):
    plane = check_table(scene(noise=0.008, seed=seed), CAMERA, WORKSPACE)
    assert plane is not None
    assert abs(plane.height) < 0.003
    assert plane.tilt < 0.7


@pytest.mark.parametrize("height", [-0.02, 0.015, 0.025])
def test_the_height_of_the_table_is_measured(height):
    plane = check_table(scene(height=height), CAMERA, WORKSPACE)
    assert plane.height == pytest.approx(height, abs=1e-3)
    assert plane.deviates


@pytest.mark.parametrize("declared", CAMERA_UNITS)
@pytest.mark.parametrize("actual", CAMERA_UNITS)
def test_a_wrong_unit_is_named_with_the_right_one(declared, actual):
    depth = scene(noise=0.002) / actual * declared
    if declared == actual:
        assert check_table(depth, CAMERA, WORKSPACE, declared) is not None
        return
    names = {1.0: "metres", 0.001: "millimetres", 0.0001: "units of 0.0001 m", 0.00025: "units of 0.00025 m"}
    with pytest.raises(CalibrationError, match=f"if depth were in {names[actual]}, not in {names[declared]}"):
        check_table(depth, CAMERA, WORKSPACE, declared)


@pytest.mark.parametrize("camera", [moved((0, 0, 0.06)), moved((0, 0, -0.06)), moved(tilt_deg=9)])
def test_a_wrong_pose_is_rejected(camera):
    with pytest.raises(CalibrationError, match=r"the table lies at z = .* not at z = 0: check the height and"):
        check_table(scene(noise=0.003), camera, WORKSPACE)


def test_the_inverse_of_a_near_vertical_pose_is_told_by_depth():
    """Both see the workspace, so the images alone cannot tell."""
    workspace = Workspace(center=(0.0, 0.0))
    true = make_camera(75, 0)
    pose = true.world_from_cam.copy()
    pose[:2, 3] -= (0.45, 0.0)
    true = Camera(true.intrinsics, pose, true.height, true.width)
    inverse = Camera(true.intrinsics, invert_rigid(pose), true.height, true.width)
    assert workspace.visible_fraction(inverse) > 0.6
    check_table(plane_depth(true), true, workspace)
    with pytest.raises(CalibrationError, match="it would lie there with the direction cam_from_world"):
        check_table(plane_depth(true), inverse, workspace)


def test_a_robot_that_hides_the_table_contradicts_nothing():
    depth = scene()
    depth[30:] = 0.3
    assert check_table(depth, CAMERA, WORKSPACE) is None


def test_an_image_without_depth_says_nothing():
    empty = np.zeros((152, 152))
    assert not has_depth(empty, CAMERA, WORKSPACE)
    assert check_table(empty, CAMERA, WORKSPACE) is None
    assert has_depth(scene(), CAMERA, WORKSPACE)
