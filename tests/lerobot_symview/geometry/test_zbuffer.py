import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_symview.geometry.camera import unproject
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.geometry.zbuffer import EMPTY, gather, zbuffer_from_depth, zbuffer_from_points
from tests.helpers.cameras import cameras, make_camera, random_depth, transformed, transformed_image

SIZE = 24
SEEDS = st.integers(0, 2**32 - 1)


def slow_zbuffer(points, workspace, pixels, ceiling=np.inf):
    """Reference implementation, point by point, with independent arithmetic."""
    height, source = np.zeros((pixels, pixels), np.float32), np.full((pixels, pixels), EMPTY)
    half, cell = workspace.size / 2, workspace.size / pixels
    for i, (x, y, z) in enumerate(points):
        if not np.isfinite([x, y, z]).all() or z > ceiling:
            continue
        row, column = np.floor([(x - workspace.center[0] + half) / cell, (y - workspace.center[1] + half) / cell])
        if 0 <= row < pixels and 0 <= column < pixels:
            at = int(row), int(column)
            if source[at] == EMPTY or np.float32(z) > height[at]:
                height[at], source[at] = z, i
    return height, source


def slow_points(depth, camera):
    """Unprojection pixel by pixel, by solving K (x, y, z) = d (u, v, 1)."""
    points = []
    for v in range(camera.height):
        for u in range(camera.width):
            d = depth[v, u]
            if not (np.isfinite(d) and d > 0):
                points.append([np.nan] * 3)
                continue
            in_camera = d * np.linalg.solve(camera.intrinsics, [u, v, 1.0])
            points.append((camera.world_from_cam @ [*in_camera, 1.0])[:3])
    return np.array(points)


@given(camera=cameras(), seed=SEEDS, ceiling=st.sampled_from([np.inf, 0.1]))
def test_zbuffer_from_depth_equals_the_reference(camera, seed, ceiling):
    depth, workspace = random_depth(seed), Workspace()
    buffer = zbuffer_from_depth(depth, camera, workspace, SIZE, ceiling)
    height, source = slow_zbuffer(slow_points(depth, camera), workspace, SIZE, ceiling)
    np.testing.assert_array_equal(buffer.source, source)
    np.testing.assert_allclose(buffer.height, height, atol=1e-6)


@given(seed=SEEDS)
def test_zbuffer_from_points_equals_the_reference(seed):
    rng, workspace = np.random.default_rng(seed), Workspace()
    heights = rng.integers(-3, 4, 400) / 50  # many ties
    points = np.column_stack([rng.uniform(0.2, 0.7, 400), rng.uniform(-0.25, 0.25, 400), heights])
    points[rng.random(400) < 0.1] = rng.choice([np.nan, np.inf, -np.inf])
    buffer = zbuffer_from_points(points, workspace, SIZE, ceiling=0.04)
    height, source = slow_zbuffer(points, workspace, SIZE, ceiling=0.04)
    np.testing.assert_array_equal(buffer.source, source)
    np.testing.assert_array_equal(buffer.height, height)


@given(camera=cameras(), seed=SEEDS)
def test_zbuffer_from_depth_equals_that_of_unprojected_points(camera, seed):
    depth, workspace = random_depth(seed), Workspace()
    valid = np.isfinite(depth) & (depth > 0)
    points = np.where(valid[..., None], unproject(np.where(valid, depth, 1.0), camera), np.nan).reshape(-1, 3)
    from_depth = zbuffer_from_depth(depth, camera, workspace, SIZE)
    np.testing.assert_array_equal(from_depth.source, zbuffer_from_points(points, workspace, SIZE).source)


@pytest.mark.parametrize("reflect", [False, True])
@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
@given(camera=cameras(), seed=SEEDS)
def test_transforming_world_and_camera_transforms_the_view_exactly(quarter_turns, reflect, camera, seed):
    depth, workspace = random_depth(seed), Workspace()
    labels = np.arange(depth.size, dtype=np.int64).reshape(depth.shape)
    buffer = zbuffer_from_depth(depth, camera, workspace, SIZE)
    transformed_camera, transformed_depth = transformed(camera, depth, quarter_turns, reflect)
    transformed_depth = np.ascontiguousarray(transformed_depth)
    transformed_buffer = zbuffer_from_depth(transformed_depth, transformed_camera, workspace, SIZE)
    np.testing.assert_array_equal(transformed_buffer.height, transformed_image(buffer.height, quarter_turns, reflect))
    source = np.where(buffer.source == EMPTY, EMPTY, labels.ravel()[buffer.source])
    flipped = labels[:, ::-1] if reflect else labels
    transformed_source = np.where(transformed_buffer.source == EMPTY, EMPTY, flipped.ravel()[transformed_buffer.source])
    np.testing.assert_array_equal(transformed_source, transformed_image(source, quarter_turns, reflect))


def test_the_highest_point_is_kept_and_ties_go_to_the_first(workspace):
    points = np.array([[0.45, 0.0, 0.1], [0.45, 0.0, 0.3], [0.45, 0.0, 0.3], [0.45, 0.0, -0.2]])
    assert zbuffer_from_points(points, workspace, 1).source.tolist() == [[1]]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_depth_of_any_float_dtype_is_accepted(dtype, workspace):
    depth = random_depth(5, (152, 152)).astype(dtype)
    assert (zbuffer_from_depth(depth, make_camera(), workspace, SIZE).source != EMPTY).any()


@pytest.mark.parametrize("bad", [0.0, -0.7, np.nan, np.inf, -np.inf])
def test_invalid_depth_gives_an_empty_buffer(bad, workspace):
    buffer = zbuffer_from_depth(np.full((152, 152), bad), make_camera(), workspace, SIZE)
    assert (buffer.source == EMPTY).all()
    assert not buffer.height.any()


def test_no_points_give_an_empty_buffer(workspace):
    assert (zbuffer_from_points(np.zeros((0, 3)), workspace, 4).source == EMPTY).all()


def test_depth_and_camera_of_different_sizes_are_rejected(workspace):
    with pytest.raises(ValueError, match=r"depth has shape \(10, 10\), the camera is \(152, 152\)"):
        zbuffer_from_depth(np.ones((10, 10)), make_camera(), workspace, SIZE)


def test_gather_returns_the_colour_and_height_of_the_shown_cells(workspace):
    points = np.array([[0.36, -0.09, 0.1], [0.54, 0.09, 0.2]])
    buffer = zbuffer_from_points(points, workspace, 2)
    colors = np.array([[[1, 2, 3], [4, 5, 6]]], dtype=np.uint8)
    rgb, height = gather(np.array([[0, 3], [1, -1]], dtype=np.int32), buffer, [colors])
    assert rgb.tolist() == [[[1, 2, 3], [4, 5, 6]], [[0, 0, 0], [0, 0, 0]]]
    np.testing.assert_allclose(height, [[0.1, 0.2], [0, 0]], rtol=1e-6)
