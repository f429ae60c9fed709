"""Several cameras in one view."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_symview import Frame, Workspace, make_view, reproject, warp_table
from lerobot_symview.geometry.camera import Camera, intrinsics_from_fov, orbit_pose, project
from lerobot_symview.geometry.fusion import SAME_SURFACE, disagreement, fuse_buffers
from lerobot_symview.geometry.homography import pixel_density
from lerobot_symview.geometry.miscalibration import Miscalibration
from lerobot_symview.geometry.zbuffer import EMPTY, ZBuffer, zbuffer_from_depth
from tests.helpers.cameras import cameras, make_camera, random_depth
from tests.lerobot_symview.geometry.test_occlusion import box_cells, table_with_box, with_lens

WORKSPACE = Workspace()
FRONT, LEFT = make_camera(40, -40), make_camera(50, 75, size=200)
CAMERAS = {"pinhole": [FRONT, LEFT], "lens": [with_lens(FRONT), LEFT], "three": [FRONT, LEFT, make_camera(35, 160)]}


def views_of(cameras, **options):
    images = [table_with_box(camera) for camera in cameras]
    rgb, depth = ([image[index] for image in images] for index in (0, 1))
    return reproject(rgb, depth, cameras, WORKSPACE, **options)


@pytest.mark.parametrize("cameras", CAMERAS.values(), ids=CAMERAS)
def test_cameras_around_a_box_leave_no_shadow(cameras):
    """Known answer: what hides from one camera is seen by another."""
    beside, inside = ~box_cells(152, margin=0.006), box_cells(152, margin=-0.006)
    single = [views_of([camera]) for camera in cameras]
    fused = views_of(cameras)
    assert all(((view.height > 0.03) & beside).sum() > 100 for view in single)
    assert ((fused.height > 0.03) & beside).sum() < 20
    assert (fused.height[inside] > 0.05).all()
    assert fused.seen.sum() > max(view.seen.sum() for view in single)


def test_a_cell_shows_the_camera_with_most_pixels_of_it():
    cameras = [make_camera(45, azimuth, size=400) for azimuth in (0, 180)]
    depth = [table_with_box(camera, np.zeros(3), np.zeros(3))[1] for camera in cameras]
    rgb = [np.full((400, 400, 3), value, np.uint8) for value in (50, 200)]
    shown = reproject(rgb, depth, cameras, WORKSPACE).rgb[..., 0]
    row = np.arange(152)[:, None] * np.ones(152)
    near = row > 90  # the first camera stands at the side of large x
    assert (shown[near] == 50).mean() > 0.9
    assert (shown[row < 62] == 200).mean() > 0.9
    swapped = reproject(rgb[::-1], depth[::-1], cameras[::-1], WORKSPACE).rgb[..., 0]
    assert (swapped == shown).mean() > 0.97  # in between, infill chooses among equally near points


@pytest.mark.parametrize("height", [0.0, 0.1])
@pytest.mark.parametrize("camera", CAMERAS["pinhole"])
def test_pixel_density_is_the_determinant_of_the_projection(camera, height):
    cells = np.array([[3, 140], [76, 20], [120, 90]])
    points = np.column_stack([WORKSPACE.xy_from_pixel(cells, 152), np.full(3, height)])
    steps = np.array([[1e-6, 0, 0], [0, 1e-6, 0]])
    jacobian = np.stack([(project(points + step, camera)[0] - project(points - step, camera)[0]) for step in steps])
    expected = np.abs(np.linalg.det(jacobian.transpose(1, 0, 2) / 2e-6))
    np.testing.assert_allclose(pixel_density(camera, WORKSPACE, 152, height)[tuple(cells.T)], expected, rtol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_fused_buffers_equal_the_slow_reference(seed):
    rng = np.random.default_rng(seed)
    cameras = [make_camera(rng.uniform(30, 60), rng.uniform(-180, 180)) for _ in range(3)]
    buffers = [
        ZBuffer(
            rng.choice([0.0, 0.005, 0.03, 0.034], (20, 20)).astype(np.float32),
            rng.integers(EMPTY, 100, (20, 20)).astype(np.int32),
        )
        for _ in cameras
    ]
    fused = fuse_buffers(buffers, cameras, WORKSPACE)
    density = [pixel_density(camera, WORKSPACE, 20) for camera in cameras]
    for row, column in np.ndindex(20, 20):
        height, source, best = 0.0, EMPTY, 0.0
        for index, buffer in enumerate(buffers):
            z, pixel = buffer.height[row, column], buffer.source[row, column]
            if pixel == EMPTY:
                continue
            is_better = z >= height - SAME_SURFACE and density[index][row, column] > best
            if source == EMPTY or z > height + SAME_SURFACE or is_better:
                height, source, best = z, index * 152 * 152 + pixel, density[index][row, column]
        assert (fused.height[row, column], fused.source[row, column]) == (np.float32(height), source)


@given(first=cameras(), second=cameras(), seed=st.integers(0, 2**32 - 2))
def test_a_fused_cell_shows_the_highest_surface_of_both_cameras(first, second, seed):
    """Source indices continue from camera to camera."""
    depths, pair = [random_depth(seed), random_depth(seed + 1)], [first, second]
    alone = [zbuffer_from_depth(depth, camera, WORKSPACE, 24) for depth, camera in zip(depths, pair, strict=True)]
    fused = fuse_buffers(alone, pair, WORKSPACE)
    heights = [np.where(buffer.source == EMPTY, -np.inf, buffer.height) for buffer in alone]
    known = fused.source != EMPTY
    np.testing.assert_array_equal(known, np.maximum(*heights) > -np.inf)
    assert (fused.height[known] >= np.maximum(*heights)[known] - np.float32(SAME_SURFACE)).all()
    of_second = fused.source >= depths[0].size
    expected = np.where(of_second, alone[1].source + depths[0].size, alone[0].source)
    np.testing.assert_array_equal(fused.source, expected)
    clear = known & (np.abs(heights[1] - heights[0]) > 1.001 * SAME_SURFACE)
    np.testing.assert_array_equal(of_second[clear], (heights[1] > heights[0])[clear])


def test_a_single_camera_and_one_without_depth_change_nothing():
    rgb, depth = table_with_box(FRONT)
    alone = reproject(rgb, depth, FRONT, WORKSPACE)
    lost = np.zeros((200, 200), np.float32)
    for view in (
        reproject([rgb], [depth], [FRONT], WORKSPACE),
        reproject([rgb, np.ones((200, 200, 3), np.uint8)], [depth, lost], [FRONT, LEFT], WORKSPACE),
        reproject([np.ones((200, 200, 3), np.uint8), rgb], [lost, depth], [LEFT, FRONT], WORKSPACE),
    ):
        for one, other in zip(view, alone, strict=True):
            np.testing.assert_array_equal(one, other)


def test_views_of_frames_equal_the_function():
    images = [table_with_box(camera) for camera in (FRONT, LEFT)]
    frame, other = [
        Frame(rgb, depth, camera, WORKSPACE) for (rgb, depth), camera in zip(images, (FRONT, LEFT), strict=True)
    ]
    made = make_view("reproj", infill="occlusion", cameras=["front", "left"]).render(
        replace(frame, others={"left": other})
    )
    np.testing.assert_array_equal(made["reproj"], views_of([FRONT, LEFT], infill="occlusion").rgb)


def test_wrong_calibrations_disagree():
    cameras = [FRONT, LEFT]
    depths = [table_with_box(camera)[1] for camera in cameras]
    assert disagreement(depths, cameras, WORKSPACE) < 0.05
    wrong = [Miscalibration(position=0.03).stated(LEFT, np.random.default_rng(seed)) for seed in range(5)]
    assert min(disagreement(depths, [FRONT, camera], WORKSPACE) for camera in wrong) > 0.2
    assert disagreement(depths, cameras, WORKSPACE, ceiling=0.005) == 0.0
    assert disagreement([np.zeros_like(depth) for depth in depths], cameras, WORKSPACE) == 0.0


def test_warped_tables_complete_each_other():
    """Each camera sees a part of the workspace; together they see all of it, each place by the better one."""
    cameras = [
        Camera(
            intrinsics_from_fov(np.deg2rad(24), 120, 160),
            orbit_pose(np.deg2rad(60), azimuth, 0.81, (0.45 + offset, 0.0, 0.0)),
            120,
            160,
        )
        for azimuth, offset in ((0.0, 0.1), (np.pi, -0.1))
    ]
    rgb = [np.full((120, 160, 3), value, np.uint8) for value in (60, 180)]
    warped = [warp_table(image, camera, WORKSPACE)[..., 0] for image, camera in zip(rgb, cameras, strict=True)]
    together = warp_table(rgb, cameras, WORKSPACE)[..., 0]
    assert all((image == 0).mean() > 0.1 for image in warped)
    assert (together == 0).mean() < min((image == 0).mean() for image in warped) / 4
    density = np.stack([pixel_density(camera, WORKSPACE, 152) for camera in cameras])
    density[np.stack(warped) < np.array([60, 180])[:, None, None]] = 0
    clear = (density.max(axis=0) > 0) & (together > 0)
    best = np.array([60, 180])[density.argmax(axis=0)]
    assert (together[clear] == best[clear]).mean() > 0.98  # the last row of an image is half black


def test_what_does_not_fit_together_is_refused():
    rgb, depth = table_with_box(FRONT)
    with pytest.raises(ValueError, match="argument 2 is shorter"):
        reproject([rgb, rgb], [depth], [FRONT, FRONT], WORKSPACE)
    other = Frame(rgb, depth, FRONT, Workspace(size=0.5))
    with pytest.raises(ValueError, match="one workspace"):
        Frame(rgb, depth, FRONT, WORKSPACE, others={"left": other})


def test_buffers_of_one_camera_are_its_own():
    _, depth = table_with_box(FRONT)
    buffer = zbuffer_from_depth(depth, FRONT, WORKSPACE, 64)
    for one, other in zip(fuse_buffers([buffer], [FRONT], WORKSPACE), buffer, strict=True):
        np.testing.assert_array_equal(one, other)
