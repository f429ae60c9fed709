"""Memory of reprojected images: what is hidden, what is not, and when it is forgotten."""

from dataclasses import replace

import numpy as np
import pytest

from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.camera import invert_rigid
from lerobot_symview.geometry.memory import FORGOTTEN, GRIPPER_DEPTH, GRIPPER_RADIUS
from lerobot_symview.geometry.miscalibration import Miscalibration
from lerobot_symview.geometry.occlusion import SEE_THROUGH
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.geometry.zbuffer import zbuffer_from_depth
from lerobot_symview.views import Frame, ViewSpec, make_view
from tests.helpers.cameras import make_camera, plane_depth, transformed, transformed_image

WORKSPACE, SIZE = Workspace(), 64
CAMERA = make_camera(size=320)
BOX, TABLE = (200, 40, 40), (90, 120, 150)
HIGH = np.array([0.15, 0.15, 0.3, 0.0, 1.0], np.float32)  # a gripper in a corner, above all that is remembered


def scene(camera=CAMERA, box=(0.02, -0.03), hidden=(), gripper=HIGH, side=0.05, height=0.04):
    """The table with a box, whose centre is relative to the workspace's; rows and columns `hidden` show an arm."""
    depth = plane_depth(camera)
    rgb = np.full((camera.height, camera.width, 3), TABLE, np.uint8)
    if box is not None:
        top = plane_depth(camera, height)
        v, u = np.mgrid[: camera.height, : camera.width]
        pixels = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
        points = (pixels * top[..., None]) @ camera.world_from_cam[:3, :3].T + camera.position
        on_box = (np.abs(points[..., :2] - WORKSPACE.center - np.array(box)) <= side / 2).all(axis=-1)
        depth, rgb[on_box] = np.where(on_box, top, depth), BOX
    for rows, columns in hidden:
        depth[rows, columns], rgb[rows, columns] = 0.25, (10, 10, 10)
    return Frame(rgb, depth.astype(np.float32), camera, WORKSPACE, gripper)


EVERYTHING = ((slice(None), slice(None)),)
LEFT_HALF = ((slice(None), slice(0, 160)),)


def episode(*frames, **options):
    render = make_view(
        "reproj", size=SIZE, **({"memory": True, "age": True, "infill": "none"} | options)
    ).start_episode()
    return [render(frame) for frame in frames]


def test_what_is_hidden_looks_as_it_was_last_seen():
    first, second, third, fourth = episode(scene(), scene(hidden=LEFT_HALF), scene(hidden=EVERYTHING), scene())
    for images, age in ((second, 1), (third, 2)):
        np.testing.assert_array_equal(images["reproj"], first["reproj"])
        np.testing.assert_array_equal(images["reproj_height"], first["reproj_height"])
        assert set(np.unique(images["reproj_age"])) <= {0, 1, age, 255}
        assert (images["reproj_age"] == age).mean() > 0.2
    for output, image in fourth.items():
        np.testing.assert_array_equal(image, first[output])
    without = episode(scene(), scene(hidden=LEFT_HALF), memory=False, age=False)[1]
    assert (without["reproj"].any(axis=2) != first["reproj"].any(axis=2)).mean() > 0.2


@pytest.mark.parametrize("infill", ["nearest", "occlusion", "local"])
def test_infill_takes_what_is_remembered_for_known(infill):
    seen, hidden = episode(scene(), scene(hidden=LEFT_HALF), infill=infill)
    differs = (hidden["reproj"] != seen["reproj"]).any(axis=2) | (hidden["reproj_height"] != seen["reproj_height"])
    # what an object hid is not remembered: `occlusion` asks the depth image of now
    assert differs.sum() <= (0.01 * differs.size if infill == "occlusion" else 0)


def test_what_moved_in_sight_leaves_no_trace():
    """The camera sees the table where the box was; what the box hides now, the table, is remembered."""
    moved = scene(box=(-0.08, 0.06))
    remembered, alone = episode(scene(), moved)[1], episode(moved)[0]
    recalled = remembered["reproj_age"][..., 0] == 1
    for output in ("reproj", "reproj_height"):
        np.testing.assert_array_equal(alone[output][~recalled], remembered[output][~recalled])
    assert (remembered["reproj"][recalled] == TABLE).all()
    assert 0 < recalled.mean() < 0.05


def test_an_unchanged_scene_or_a_moving_camera_leaves_everything_as_without_memory():
    around = [scene(make_camera(azimuth=azimuth, size=320)) for azimuth in (0, 2, 4, 6)]
    for frames in ([scene()] * 3, around):
        made = episode(*frames, infill="nearest", memory=True)
        alone = episode(*frames, infill="nearest", memory=False, age=False)
        for images, expected in zip(made, alone, strict=True):
            differs = np.abs(images["reproj_height"] - expected["reproj_height"]) > 0.005
            assert differs.mean() < (0.02 if frames is around else 1e-9)  # the box's hidden side is remembered


def test_what_the_gripper_reaches_is_forgotten():
    at_box = np.array([0.02, -0.03, 0.04, 0.0, 1.0], np.float32)
    above = at_box + np.array([0, 0, 0.04, 0, 0], np.float32)
    kept, forgotten = (episode(scene(), scene(hidden=EVERYTHING, gripper=pose))[1] for pose in (above, at_box))
    assert (kept["reproj"] == BOX).all(axis=2).sum() > 30
    assert not (forgotten["reproj"] == BOX).all(axis=2).any()
    rows, columns = np.nonzero((forgotten["reproj_age"] == 255).all(axis=2) & (kept["reproj_age"] == 1).all(axis=2))
    xy = WORKSPACE.xy_from_pixel(np.stack([rows, columns], axis=-1), SIZE) - WORKSPACE.center
    assert np.linalg.norm(xy - at_box[:2], axis=-1).max() <= GRIPPER_RADIUS


def test_a_camera_that_sees_nothing_hides_nothing_new():
    """Invalid depth is no evidence: what was seen is kept."""
    dead = replace(scene(), depth=np.zeros((320, 320), np.float32))
    seen, kept = episode(scene(), dead)
    np.testing.assert_array_equal(kept["reproj"], seen["reproj"])


def test_one_of_two_cameras_that_looks_through_ends_the_memory():
    back = make_camera(azimuth=180, size=320)
    both = [
        replace(scene(box=box, hidden=hidden), others={"back": scene(back, box=box)})
        for box, hidden in (((0.02, -0.03), ()), (None, EVERYTHING))
    ]
    assert not (episode(*both, cameras=["back"])[1]["reproj"] == BOX).all(axis=2).any()
    assert (episode(*both)[1]["reproj"] == BOX).all(axis=2).any()


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
@pytest.mark.parametrize("reflect", [False, True])
def test_memory_turns_with_the_scene(quarter_turns, reflect):
    frames = [scene(), scene(hidden=LEFT_HALF, gripper=None)]
    expected = episode(*frames)[1]
    turned = []
    for frame in frames:
        camera, rgb = transformed(frame.camera, frame.rgb, quarter_turns, reflect)
        _, depth = transformed(frame.camera, frame.depth, quarter_turns, reflect)
        turned.append(Frame(rgb, np.ascontiguousarray(depth), camera, WORKSPACE))
    made = episode(*turned)[1]
    for output, image in expected.items():
        difference = made[output] != transformed_image(image, quarter_turns, reflect)
        assert difference.mean() < 0.002, output  # points on the border of two cells


def test_memory_equals_its_definition():
    """Cell by cell, for a camera that moves and depth with errors."""
    rng = np.random.default_rng(0)
    frames, gripper = [], np.array([0.0, 0.0, 0.05, 0.0, 1.0], np.float32)
    for step in range(4):
        camera = Miscalibration(position=0.02).stated(CAMERA, rng)
        columns = slice(60 * step, 60 * step + 90)
        frame = scene(camera, hidden=((slice(None), columns),), gripper=gripper + np.float32(0.01 * step))
        frames.append(replace(frame, depth=frame.depth * (rng.random(frame.depth.shape) > 0.1)))
    made = episode(*frames)
    height, age = np.zeros((SIZE, SIZE)), np.full((SIZE, SIZE), FORGOTTEN)
    view = make_view("reproj", size=SIZE)
    for frame, images in zip(frames, made, strict=True):
        ceiling = view.ceiling(frame.gripper_height)
        buffer = zbuffer_from_depth(frame.depth, frame.camera, WORKSPACE, SIZE, ceiling)
        for i, j in np.ndindex(SIZE, SIZE):
            if buffer.source[i, j] >= 0:
                height[i, j], age[i, j] = buffer.height[i, j], 0
            elif age[i, j] != FORGOTTEN:
                age[i, j] = age[i, j] + 1 if is_hidden(frame, i, j, height[i, j]) else FORGOTTEN
        np.testing.assert_array_equal(images["reproj_age"][..., 0], np.where(age == FORGOTTEN, 255, age))
        np.testing.assert_allclose(images["reproj_height"], np.where(age == FORGOTTEN, 0, height), atol=1e-6)


def is_hidden(frame, row, column, height):
    xy = WORKSPACE.xy_from_pixel(np.array([[row, column]]), SIZE)[0]
    near = np.linalg.norm(xy - WORKSPACE.center - frame.gripper[:2]) <= GRIPPER_RADIUS
    if near and height >= frame.gripper[2] - GRIPPER_DEPTH:
        return False
    point = (invert_rigid(frame.camera.world_from_cam) @ [*xy, height, 1.0])[:3]
    u, v = np.floor((frame.camera.intrinsics @ point / point[2])[:2] + 0.5).astype(int)
    if not (0 <= u < frame.camera.width and 0 <= v < frame.camera.height):
        return True
    measured = frame.depth[v, u]
    return not (measured > 0 and measured >= point[2] - SEE_THROUGH)


def test_episodes_of_one_view_are_independent_and_a_single_image_starts_one():
    view = make_view("reproj", size=SIZE, memory=True)
    first, second = view.start_episode(), view.start_episode()
    first(scene())
    hidden = scene(hidden=LEFT_HALF)
    alone = second(hidden)
    np.testing.assert_array_equal(alone["reproj"], view.render(hidden)["reproj"])
    assert (first(hidden)["reproj"] != alone["reproj"]).any()


def test_age_without_memory_raises():
    with pytest.raises(OptionError, match="needs memory=true"):
        ViewSpec("reproj", {"age": True}).make()
