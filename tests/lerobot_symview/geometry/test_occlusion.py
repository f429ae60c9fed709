"""Infill that knows what hides an empty cell."""

import numpy as np
import pytest

from lerobot_symview import reproject
from lerobot_symview.geometry.camera import Camera, project, unproject
from lerobot_symview.geometry.infill import nearest_known
from lerobot_symview.geometry.lens import PLUMB_BOB, Lens
from lerobot_symview.geometry.occlusion import SEE_THROUGH, without_smear
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.geometry.zbuffer import EMPTY, zbuffer_from_depth
from tests.helpers.cameras import make_camera, transformed, transformed_image

WORKSPACE = Workspace()
LENS = Lens(PLUMB_BOB, (-0.2, 0.05, 0.001, -0.002, 0.0))
LOW, HIGH = np.array([0.42, -0.03, 0.0]), np.array([0.48, 0.04, 0.06])
TABLE, BOX = (90, 120, 90), (200, 30, 30)


def with_lens(camera):
    return Camera(camera.intrinsics, camera.world_from_cam, camera.height, camera.width, LENS)


def table_with_box(camera, low=LOW, high=HIGH):
    """RGB and depth of a table on which an axis-parallel box stands: the slabs that a ray crosses."""
    along = unproject(np.ones((camera.height, camera.width)), camera) - camera.position  # at depth 1
    with np.errstate(divide="ignore"):
        ends = np.stack([(low - camera.position) / along, (high - camera.position) / along])
    enters, leaves = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    on_box = (enters < leaves) & (enters > 0)
    depth = np.where(on_box, enters, -camera.position[2] / along[..., 2])
    return np.where(on_box[..., None], BOX, TABLE).astype(np.uint8), depth.astype(np.float32)


def box_cells(size, low=LOW, high=HIGH, margin=0.0):
    """The cells whose centres lie in the box, made larger by `margin` metres."""
    xy = WORKSPACE.xy_from_pixel(np.stack(np.mgrid[:size, :size], axis=-1), size)
    return ((xy > low[:2] - margin) & (xy < high[:2] + margin)).all(axis=-1)


CAMERAS = {f"{elevation}, {azimuth}": make_camera(elevation, azimuth) for elevation in (30, 55) for azimuth in (0, -70)}
CAMERAS["lens"] = with_lens(make_camera(45, 20))


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("source_scale", [1, 2])
def test_the_shadow_of_a_box_shows_the_table(camera, source_scale):
    """Known answer: nothing of the box lies beside it, and the table fills its shadow."""
    rgb, depth = table_with_box(camera)
    views = {
        infill: reproject(rgb, depth, camera, WORKSPACE, infill=infill, source_scale=source_scale)
        for infill in ("nearest", "occlusion", "none")
    }
    beside = ~box_cells(152, margin=0.006)  # two cells: a pixel of the edge lies half on the box
    smear = {infill: (view.height > 0.03) & beside for infill, view in views.items()}
    assert smear["nearest"].sum() > 100
    assert smear["occlusion"].sum() < 0.05 * smear["nearest"].sum()
    shown = views["occlusion"]
    assert (shown.height[box_cells(152, margin=-0.01)] > 0.05).all()  # at 30 degrees a pixel covers 9 mm of the top
    assert (shown.rgb[beside & (shown.height < 0.001)] == TABLE).all()
    np.testing.assert_array_equal(shown.seen, views["none"].seen)
    np.testing.assert_array_equal(shown.rgb[shown.seen], views["none"].rgb[shown.seen])
    np.testing.assert_array_equal(shown.height[shown.seen], views["none"].height[shown.seen])


def slow_replacement(shown, buffer, depth, camera):
    """Reference implementation: cell by cell through world points."""
    size = len(shown)
    chosen = shown.copy()
    foot = WORKSPACE.pixel_from_xy(camera.position[:2], size)

    def contradicts(row, column, height):
        point = [*WORKSPACE.xy_from_pixel(np.array([row, column]), size), float(height)]
        (u, v), distance = project(np.array(point), camera)
        u, v = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
        inside = 0 <= u < camera.width and 0 <= v < camera.height
        return inside and np.isfinite(depth[v, u]) and depth[v, u] > distance + SEE_THROUGH

    for row, column in np.argwhere((buffer.source == EMPTY) & (shown >= 0)):
        height = buffer.height.flat[shown[row, column]]
        if height < SEE_THROUGH or not contradicts(row, column, height):
            continue
        direction = np.array([row, column]) - foot
        direction /= np.abs(direction).max()
        paths = [np.array([row, column]) + sign * direction * np.arange(1, 2 * size)[:, None] for sign in (1, -1)]
        for r, c in np.floor(np.concatenate(paths) + 0.5).astype(int):
            is_known = 0 <= r < size and 0 <= c < size and buffer.source[r, c] != EMPTY
            if is_known and not contradicts(row, column, buffer.height[r, c]):
                chosen[row, column] = r * size + c
                break
    return chosen


@pytest.mark.parametrize("seed", range(3))
def test_replaced_cells_equal_the_slow_reference(seed):
    rng = np.random.default_rng(seed)
    camera = make_camera(rng.uniform(20, 70), rng.uniform(-180, 180), size=48)
    low = np.array([*rng.uniform([0.3, -0.15], [0.5, 0.1]), 0.0])
    _, depth = table_with_box(camera, low, low + [*rng.uniform(0.03, 0.1, 2), 0.08])
    depth[rng.random(depth.shape) < 0.1] = 0
    depth[rng.random(depth.shape) < 0.02] = np.inf
    buffer = zbuffer_from_depth(depth, camera, WORKSPACE, 64)
    shown = nearest_known(buffer.source != EMPTY)
    chosen = without_smear(shown, buffer, depth, camera, WORKSPACE)
    expected = slow_replacement(shown, buffer, depth, camera)
    assert (chosen != shown).sum() > 20
    assert (chosen != expected).mean() < 1e-3  # a step that ends between two cells, rounded otherwise
    known = buffer.source != EMPTY
    np.testing.assert_array_equal(chosen[known], shown[known])


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
@pytest.mark.parametrize("reflect", [False, True])
def test_the_infilled_view_moves_with_the_scene(quarter_turns, reflect):
    camera = make_camera(40, 25)
    rgb, depth = table_with_box(camera)
    moved, moved_depth = transformed(camera, depth, quarter_turns, reflect)
    view = reproject(rgb, depth, camera, WORKSPACE, infill="occlusion")
    moved_rgb = np.ascontiguousarray(rgb[:, ::-1] if reflect else rgb)
    other = reproject(moved_rgb, np.ascontiguousarray(moved_depth), moved, WORKSPACE, infill="occlusion")
    expected = transformed_image(view.height, quarter_turns, reflect)
    assert (np.abs(other.height - expected) > 0.001).mean() < 0.003  # among equally near points the leftmost wins


@pytest.mark.parametrize("kind", ["from above", "no depth", "only the table"])
def test_where_nothing_is_hidden_the_nearest_point_is_shown(kind):
    camera = make_camera(90 if kind == "from above" else 45, size=100)
    rgb, depth = table_with_box(camera, HIGH, HIGH) if kind == "only the table" else table_with_box(camera)
    if kind == "no depth":
        depth[:] = 0
    views = [reproject(rgb, depth, camera, WORKSPACE, infill=infill) for infill in ("nearest", "occlusion")]
    differing = np.abs(views[0].height - views[1].height) > 0.001
    assert differing.sum() <= (60 if kind == "from above" else 0)  # the sides of the box, seen from its middle


def test_the_arm_hides_cells_without_a_contradiction():
    """Clipped points are in front of the cells that they hide, and say nothing about them."""
    camera = make_camera(45)
    rgb, depth = table_with_box(camera, LOW, HIGH + [0, 0, 0.1])
    views = [reproject(rgb, depth, camera, WORKSPACE, clip=0.05, infill=infill) for infill in ("nearest", "occlusion")]
    assert (views[0].height == views[1].height).mean() > 0.98
