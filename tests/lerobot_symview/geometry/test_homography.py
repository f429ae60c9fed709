import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera, project, stored_camera
from lerobot_symview.geometry.homography import camera_direction, image_from_topdown, warp_map, warp_plane
from lerobot_symview.geometry.workspace import Workspace
from tests.helpers.cameras import cameras, make_camera, transformed, transformed_image, world_transform

POSES = [(45, 0), (15, 60), (75, -100), (90, 0)]


@pytest.mark.parametrize("height", [0.0, 0.025, 0.1])
@pytest.mark.parametrize(("elevation", "azimuth"), POSES)
def test_the_homography_equals_opencvs_solution_from_the_corners(workspace, elevation, azimuth, height):
    camera = make_camera(elevation, azimuth)
    projected, _ = project(workspace.corners(height), camera)
    flat = np.array([[-0.5, -0.5], [151.5, -0.5], [151.5, 151.5], [-0.5, 151.5]])  # TL, TR, BR, BL as (u, v)
    solved = cv2.getPerspectiveTransform(flat.astype(np.float32), projected.astype(np.float32))
    ours = image_from_topdown(camera, workspace, 152, height)
    np.testing.assert_allclose(ours / ours[2, 2], solved, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("elevation", "azimuth"), POSES)
def test_table_points_map_to_their_projections(workspace, elevation, azimuth):
    camera = make_camera(elevation, azimuth)
    row, column = workspace.pixel_from_xy(np.array([0.53, -0.12]), 76)
    u, v, w = image_from_topdown(camera, workspace, 76) @ [column, row, 1]
    pixel, _ = project(np.array([0.53, -0.12, 0.0]), camera)
    np.testing.assert_allclose([u / w, v / w], pixel, atol=1e-9)


def test_the_warp_of_a_top_down_camera_is_the_identity(workspace):
    size = 60
    fov = 2 * np.rad2deg(np.arctan(workspace.size / 2 / 0.81))
    camera = make_camera(90.0, size=size, fov=fov)
    rgb = np.random.default_rng(0).integers(0, 256, (size, size, 3), dtype=np.uint8)
    np.testing.assert_array_equal(warp_plane(rgb, warp_map(camera, workspace, size)), rgb)


@given(camera=cameras((60, 80)), height=st.floats(0.0, 0.05))
def test_view_corners_map_to_workspace_corners_within_a_thousandth_of_a_pixel(camera, height):
    workspace, pixels = Workspace(), 76
    corners = workspace.corners(height)
    assume((project(corners, camera)[1] > 0).all())
    edges = np.array([[-0.5, -0.5], [75.5, -0.5], [75.5, 75.5], [-0.5, 75.5]])  # TL, TR, BR, BL as (column, row)
    mapped = image_from_topdown(camera, workspace, pixels, height) @ np.column_stack([edges, np.ones(4)]).T
    np.testing.assert_allclose((mapped[:2] / mapped[2]).T, project(corners, camera)[0], atol=1e-3)


@given(camera=cameras((60, 80)))
def test_the_warp_samples_where_the_homography_maps(camera):
    """Each pixel is interpolated bilinearly at its homography's image point, within OpenCV's steps of 1/32 pixel."""
    workspace, pixels = Workspace(), 30
    assume((project(workspace.corners(), camera)[1] > 0).all())
    ramp = np.add.outer(np.arange(60) * 2.0, np.arange(80) * 1.5)  # linear, so that it can be evaluated anywhere
    image = np.repeat(np.rint(ramp)[..., None], 3, axis=-1).astype(np.uint8)
    columns, rows = np.meshgrid(np.arange(pixels), np.arange(pixels))
    u, v, w = image_from_topdown(camera, workspace, pixels) @ np.stack([columns.ravel(), rows.ravel(), np.ones(900)])
    u, v = (u / w).reshape(pixels, pixels), (v / w).reshape(pixels, pixels)
    inside = (u > 0) & (u < 79) & (v > 0) & (v < 59)
    warped = warp_plane(image, warp_map(camera, workspace, pixels))
    np.testing.assert_allclose(warped[..., 0][inside], (2 * v + 1.5 * u)[inside], atol=1.2)
    outside = (u < -1) | (u > 80) | (v < -1) | (v > 60)
    assert not warped[outside].any()


@pytest.mark.parametrize("reflect", [False, True])
@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
@given(camera=cameras((60, 80)), height=st.floats(0.0, 0.05))
def test_transforming_world_and_camera_transforms_the_sampled_points(quarter_turns, reflect, camera, height):
    workspace, pixels = Workspace(), 20
    assume((project(workspace.corners(height), camera)[1] > 0).all())
    labels = np.arange(pixels**2).reshape(pixels, pixels)

    def sampled(camera):
        columns, rows = np.meshgrid(np.arange(pixels), np.arange(pixels))
        flat = np.stack([columns.ravel(), rows.ravel(), np.ones(pixels**2)])
        u, v, w = image_from_topdown(camera, workspace, pixels, height) @ flat
        return np.column_stack([u / w, v / w])

    transformed_camera, _ = transformed(camera, np.zeros((60, 80)), quarter_turns, reflect)
    expected = sampled(camera)[transformed_image(labels, quarter_turns, reflect).ravel()]
    if reflect:
        expected[:, 0] = camera.width - 1 - expected[:, 0]
    np.testing.assert_allclose(sampled(transformed_camera), expected, rtol=1e-6, atol=1e-6)


def test_maps_of_unchanged_cameras_are_cached(workspace):
    arrays = make_camera().intrinsics.astype(np.float32), make_camera().world_from_cam.astype(np.float32)
    first, second = (stored_camera(*(array.copy() for array in arrays), 152, 152) for _ in range(2))
    assert warp_map(first, workspace, 76) is warp_map(second, workspace, 76)
    assert warp_map(first, workspace, 76) is not warp_map(first, workspace, 76, 0.01)


def test_a_plane_behind_the_camera_is_rejected(workspace):
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


def test_camera_direction_is_zero_above_the_centre(workspace):
    np.testing.assert_allclose(camera_direction(make_camera(90), workspace), 0, atol=1e-12)


@pytest.mark.parametrize("reflect", [False, True])
@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
@given(camera=cameras())
def test_camera_direction_transforms_with_the_world(quarter_turns, reflect, camera):
    transformed_camera, _ = transformed(camera, np.zeros((40, 56)), quarter_turns, reflect)
    expected = world_transform(quarter_turns, reflect)[:2, :2] @ camera_direction(camera, Workspace())
    np.testing.assert_allclose(camera_direction(transformed_camera, Workspace()), expected, atol=1e-9)
