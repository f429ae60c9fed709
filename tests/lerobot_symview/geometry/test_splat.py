"""Splats: footprints of pixels fill what lies between the pixels' points, and nothing else."""

import numpy as np
import pytest

from lerobot_symview.geometry.camera import project
from lerobot_symview.geometry.splat import with_splats
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.geometry.zbuffer import EMPTY, zbuffer_from_depth
from lerobot_symview.views import Frame, make_view
from tests.helpers.cameras import make_camera, plane_depth, random_depth, transformed, transformed_image

WORKSPACE, SIZE = Workspace(), 48
CAMERA = make_camera(size=40)


def buffers(depth, camera=CAMERA, size=SIZE):
    points = zbuffer_from_depth(depth, camera, WORKSPACE, size)
    return points, with_splats(points, [depth], [camera], WORKSPACE)


@pytest.mark.parametrize("elevation", [30, 45, 75])
def test_footprints_tile_a_plane(elevation):
    """Where the image shows the table, no cell is empty, and every cell shows the pixel that sees its centre."""
    camera = make_camera(elevation=elevation, size=40)
    points, splatted = buffers(plane_depth(camera), camera)
    rows, columns = np.indices((SIZE, SIZE))
    xy = WORKSPACE.xy_from_pixel(np.stack([rows, columns], axis=-1), SIZE)
    pixels = project(np.concatenate([xy, np.zeros((SIZE, SIZE, 1))], axis=-1), camera)[0]
    u, v = np.moveaxis(np.floor(np.asarray(pixels) + 0.5).astype(int), -1, 0)
    visible = (u >= 0) & (v >= 0) & (u < 40) & (v < 40)
    assert (points.source[visible] == EMPTY).mean() > 0.2
    filled = visible & (points.source == EMPTY)
    assert (splatted.source[filled] != EMPTY).mean() > 0.95  # the footprint is that of an affine image
    shown = filled & (splatted.source != EMPTY)
    assert (splatted.source[shown] == (v * 40 + u)[shown]).mean() > 0.9
    np.testing.assert_allclose(splatted.height[shown], 0, atol=1e-6)


def test_points_keep_their_cells_and_sources_are_theirs():
    depth = random_depth(3, (40, 40)).astype(np.float32)
    points, splatted = buffers(depth)
    known = points.source != EMPTY
    for before, after in zip(points, splatted, strict=True):
        np.testing.assert_array_equal(before[known], after[known])
    assert set(np.unique(splatted.source)) <= set(np.unique(points.source))


def test_splats_equal_their_definition():
    """Cell by cell, with numerical derivatives of the footprint."""
    depth = plane_depth(CAMERA, 0.0)
    depth[10:20, 10:25] = plane_depth(CAMERA, 0.05)[10:20, 10:25]
    points, splatted = buffers(depth)
    scale = SIZE / WORKSPACE.size
    covered = {}
    inverse = np.linalg.inv(CAMERA.intrinsics)

    def on_plane(u, v, z):
        ray = CAMERA.world_from_cam[:3, :3] @ inverse @ [u, v, 1.0]
        point = CAMERA.position + ray * (z - CAMERA.position[2]) / ray[2]
        return (point[:2] - WORKSPACE.center) * scale + SIZE / 2

    for row, column in np.argwhere(points.source != EMPTY):
        pixel, z = int(points.source[row, column]), float(points.height[row, column])
        u, v = pixel % 40, pixel // 40
        center = on_plane(u, v, z)
        step = 1e-5
        axes = np.stack([on_plane(u + step, v, z) - center, on_plane(u, v + step, z) - center], axis=1) / step
        for r, c in np.ndindex(SIZE, SIZE):
            s = np.linalg.solve(axes, [r + 0.5 - center[0], c + 0.5 - center[1]])
            if points.source[r, c] == EMPTY and np.abs(s).max() < 0.4999:
                covered[r, c] = max(covered.get((r, c), (-1.0, 0)), (round(z, 5), -pixel))
    for (r, c), (z, _) in covered.items():
        assert splatted.source[r, c] != EMPTY
        assert splatted.height[r, c] >= z - 2e-5
    extra = (splatted.source != EMPTY) & (points.source == EMPTY)
    assert extra.sum() <= 1.02 * len(covered)


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
@pytest.mark.parametrize("reflect", [False, True])
def test_splats_turn_with_the_scene(quarter_turns, reflect):
    depth = random_depth(5, (40, 40)).astype(np.float32)
    camera, turned = transformed(CAMERA, depth, quarter_turns, reflect)
    expected = transformed_image(buffers(depth)[1].height, quarter_turns, reflect)
    assert (buffers(np.ascontiguousarray(turned), camera)[1].height != expected).mean() < 0.005


def test_a_step_is_not_drawn_farther_than_half_a_footprint():
    """A raised square seen from 45 degrees: nearest infill draws it long into its shadow, splats do not."""
    camera = make_camera(size=60)
    top, table = plane_depth(camera, 0.06), plane_depth(camera)
    depth = table.copy()
    depth[20:32, 22:38] = top[20:32, 22:38]
    rgb = np.zeros((60, 60, 3), np.uint8)
    frame = Frame(rgb, depth.astype(np.float32), camera, WORKSPACE)
    high = {
        infill: (make_view("reproj", size=96, infill=infill).render(frame)["reproj_height"] > 0.03).sum()
        for infill in ("nearest", "splat")
    }
    cell = WORKSPACE.size / 96
    points, _ = buffers(depth.astype(np.float32), camera, 96)
    rows, columns = np.nonzero((points.height > 0.03) & (points.source != EMPTY))
    extent = ((np.ptp(rows) + 1) * (np.ptp(columns) + 1)) * cell**2
    assert high["splat"] * cell**2 < 1.35 * extent
    assert high["nearest"] > 1.1 * high["splat"]


@pytest.mark.parametrize("depth", [np.zeros((40, 40), np.float32), np.full((40, 40), np.nan, np.float32)])
def test_no_points_make_no_splats(depth):
    assert (buffers(depth)[1].source == EMPTY).all()


def test_every_camera_covers_its_own_pixels():
    other = make_camera(azimuth=90, size=56)
    depths = [plane_depth(camera).astype(np.float32) for camera in (CAMERA, other)]
    rgb = [np.full((size, size, 3), value, np.uint8) for size, value in ((40, 60), (56, 180))]
    view = make_view("reproj", size=SIZE, infill="splat", cameras=["left"])
    left = Frame(rgb[1], depths[1], other, WORKSPACE)
    made = view.render(Frame(rgb[0], depths[0], CAMERA, WORKSPACE, others={"left": left}))
    assert set(np.unique(made["reproj"])) == {60, 180}
    np.testing.assert_allclose(made["reproj_height"], 0, atol=1e-6)
