import numpy as np
import pytest

from lerobot_symview.geometry.camera import (
    CalibrationError,
    Camera,
    intrinsics_from_fov,
    invert_rigid,
    orbit_pose,
    project,
    transform,
    unproject,
)
from tests.helpers.cameras import make_camera

POSES = [(45, 0), (15, 90), (75, -130), (90, 0)]


def test_orbit_pose_at_90_degrees_has_rows_along_x_and_columns_along_y():
    world_from_cam = orbit_pose(np.pi / 2, 0.0, 1.0, (0, 0, 0))
    expected = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]]
    np.testing.assert_allclose(world_from_cam, expected, atol=1e-12)


@pytest.mark.parametrize(("elevation", "azimuth"), POSES)
def test_orbit_pose_is_rigid_and_puts_the_target_on_the_optical_axis(elevation, azimuth):
    camera = make_camera(elevation, azimuth)
    np.testing.assert_allclose(camera.cam_from_world @ camera.world_from_cam, np.eye(4), atol=1e-12)
    pixel, depth = project(np.array([0.45, 0.0, 0.0]), camera)
    np.testing.assert_allclose(pixel, [75.5, 75.5], atol=1e-9)
    assert depth == pytest.approx(0.81)


@pytest.mark.parametrize(("elevation", "azimuth"), POSES)
def test_unproject_inverts_project(elevation, azimuth):
    camera = make_camera(elevation, azimuth, size=20)
    depth = np.random.default_rng(0).uniform(0.3, 2.0, size=(20, 20))
    pixels, again = project(unproject(depth, camera), camera)
    u, v = np.meshgrid(np.arange(20), np.arange(20))
    np.testing.assert_allclose(pixels, np.stack([u, v], axis=-1), atol=1e-9)
    np.testing.assert_allclose(again, depth, atol=1e-12)


def test_depth_is_along_the_optical_axis_not_the_ray():
    camera = make_camera(90.0)
    points = unproject(np.full((152, 152), 0.81), camera)
    np.testing.assert_allclose(points[..., 2], 0.0, atol=1e-12)


def test_the_field_of_view_spans_the_outer_edges_of_the_border_pixels():
    intrinsics = intrinsics_from_fov(np.pi / 2, 10, 10)
    edge = intrinsics @ [1.0, 0.0, 1.0]  # 45 degrees to the right
    assert edge[0] == pytest.approx(9.5)


def test_invert_rigid_and_transform_agree():
    a_from_b = orbit_pose(0.7, 0.3, 2.0, (1, 2, 3))
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(transform(invert_rigid(a_from_b), transform(a_from_b, points)), points, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda k, t: (k * -1, t), "focal lengths must be positive"),
        (lambda k, t: (k + [[0, 0, 500], [0, 0, 0], [0, 0, 0]], t), "lies outside the 152 x 152 image"),
        (lambda k, t: (k + [[0, 1, 0], [0, 0, 0], [0, 0, 0]], t), "intrinsics must be"),
        (lambda k, t: (k, t * 1.01), "not orthonormal"),
        (lambda k, t: (k, t @ np.diag([-1, 1, 1, 1])), "left-handed"),
        (lambda k, t: (k, t * np.nan), "finite"),
        (lambda k, t: (k[:2], t), "shape"),
        (lambda k, t: (k, t[:3]), "shape"),
    ],
)
def test_invalid_calibrations_are_rejected(change, message):
    camera = make_camera()
    with pytest.raises(CalibrationError, match=message):
        Camera(*change(camera.intrinsics, camera.world_from_cam), 152, 152)


def test_one_error_lists_all_problems():
    with pytest.raises(CalibrationError, match=r"focal lengths.*orthonormal"):
        Camera(np.diag([-1.0, 1.0, 1.0]), 2 * np.eye(4), 10, 10)
