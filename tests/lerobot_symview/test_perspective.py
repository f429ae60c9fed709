import cv2
import numpy as np
import pytest

from lerobot_symview.camera import CalibrationError, Camera, project
from lerobot_symview.perspective import camera_direction, image_from_topdown, warp_plane
from tests.conftest import make_camera

POSES = [(45, 0), (15, 60), (75, -100), (90, 0)]


@pytest.mark.parametrize("height", [0.0, 0.025, 0.1])
@pytest.mark.parametrize(("elevation", "azimuth"), POSES)
def test_the_homography_is_the_one_opencv_solves_for_from_the_corners(workspace, elevation, azimuth, height):
    camera = make_camera(elevation, azimuth)
    seen, _ = project(workspace.corners(height), camera)
    flat = np.array([[-0.5, -0.5], [151.5, -0.5], [151.5, 151.5], [-0.5, 151.5]])  # TL, TR, BR, BL as (u, v)
    solved = cv2.getPerspectiveTransform(flat.astype(np.float32), seen.astype(np.float32))
    ours = image_from_topdown(camera, workspace, 152, height)
    np.testing.assert_allclose(ours / ours[2, 2], solved, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("elevation", "azimuth"), POSES)
def test_table_points_land_on_their_pixels(workspace, elevation, azimuth):
    camera = make_camera(elevation, azimuth)
    row, column = workspace.pixel_from_xy(np.array([0.53, -0.12]), 76)
    u, v, w = image_from_topdown(camera, workspace, 76) @ [column, row, 1]
    pixel, _ = project(np.array([0.53, -0.12, 0.0]), camera)
    np.testing.assert_allclose([u / w, v / w], pixel, atol=1e-9)


def test_a_camera_at_the_oracles_place_is_left_unchanged(workspace):
    size = 60
    fov = 2 * np.rad2deg(np.arctan(workspace.size / 2 / 0.81))
    camera = make_camera(90.0, size=size, fov=fov)
    rgb = np.random.default_rng(0).integers(0, 256, (size, size, 3), dtype=np.uint8)
    np.testing.assert_array_equal(warp_plane(rgb, image_from_topdown(camera, workspace, size), size), rgb)


def test_a_camera_that_cannot_see_the_plane_is_refused(workspace):
    inside = make_camera(45.0)
    pose = inside.world_from_cam.copy()
    pose[:3, 3] = [0.45, 0.0, 0.05]
    with pytest.raises(CalibrationError, match="behind the camera"):
        image_from_topdown(Camera(inside.intrinsics, pose, 152, 152), workspace, 76)


@pytest.mark.parametrize(
    ("azimuth", "direction"), [(0, (1, 0)), (90, (0, 1)), (180, (-1, 0)), (45, (0.5**0.5, 0.5**0.5))]
)
def test_camera_direction_points_from_the_centre_to_the_camera(workspace, azimuth, direction):
    np.testing.assert_allclose(camera_direction(make_camera(45, azimuth), workspace), direction, atol=1e-12)


def test_camera_direction_is_zero_straight_above(workspace):
    np.testing.assert_allclose(camera_direction(make_camera(90), workspace), 0, atol=1e-12)
