"""Lenses against OpenCV, their inverses, and views through them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera, ideal_pixels, project, stored_camera, to_ideal, unproject
from lerobot_symview.geometry.lens import EQUIDISTANT, PLUMB_BOB, RATIONAL, Lens, lens_from_coefficients, stored_lens
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.geometry.zbuffer import zbuffer_from_depth
from lerobot_symview.views import Frame, make_view
from tests.helpers.cameras import make_camera, plane_depth

LENSES = {
    "webcam": Lens(PLUMB_BOB, (-0.27, 0.05, 0.001, -0.002, 0.0)),
    "pincushion": Lens(PLUMB_BOB, (0.09, -0.18, 0.0005, -0.0003)),
    "rational": Lens(RATIONAL, (0.4, -0.1, 0.0006, -0.0004, 0.02, 0.7, -0.02, 0.01)),
    "fisheye": Lens(EQUIDISTANT, (0.05, -0.01, 0.003, -0.0004)),
}
every_lens = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)


def through(lens, size=60, **place):
    return replace(make_camera(size=size, **place), lens=lens)


def points_seen(camera, count=200):
    """Random world points in front of a camera, up to its image's corners."""
    rng = np.random.default_rng(0)
    rays = rng.uniform(-0.45, 0.45, (count, 2))
    in_camera = np.column_stack([rays, np.ones(count)]) * rng.uniform(0.3, 2.0, (count, 1))
    return in_camera @ camera.world_from_cam[:3, :3].T + camera.position, in_camera


@every_lens
def test_projection_equals_that_of_opencv(lens):
    camera = through(lens)
    points, in_camera = points_seen(camera)
    module = cv2.fisheye.projectPoints if lens.model == EQUIDISTANT else cv2.projectPoints
    arguments = (np.zeros(3), np.zeros(3), camera.intrinsics, np.array(lens.coefficients))
    expected, _ = module(in_camera[:, None], *arguments)
    np.testing.assert_allclose(project(points, camera)[0], expected[:, 0], atol=1e-9)


@every_lens
def test_unproject_inverts_project_through_a_lens(lens):
    camera = through(lens, elevation=50, azimuth=20)
    depth = np.random.default_rng(0).uniform(0.3, 2.0, (60, 60))
    pixels, again = project(unproject(depth, camera), camera)
    u, v = np.meshgrid(np.arange(60), np.arange(60))
    np.testing.assert_allclose(pixels, np.stack([u, v], axis=-1), atol=1e-6)
    np.testing.assert_allclose(again, depth, atol=1e-12)


@every_lens
def test_the_map_of_ideal_pixels_is_cached_while_the_camera_moves(lens):
    here, there = through(lens), through(lens, azimuth=90)
    assert ideal_pixels(here.optics)[0] is ideal_pixels(there.optics)[0]
    assert not ideal_pixels(here.optics)[0].flags.writeable


@every_lens
@pytest.mark.parametrize("size", [(30, 30), (120, 180)])
def test_a_resized_camera_shows_the_same_rays_at_the_same_places(lens, size):
    """The outer edges of the image do not move, with integer coordinates at pixel centres."""
    camera = through(lens)
    resized = camera.resized(*size)
    points, _ = points_seen(camera)
    scale = np.array([size[1], size[0]]) / 60
    expected = (project(points, camera)[0] + 0.5) * scale - 0.5
    np.testing.assert_allclose(project(points, resized)[0], expected, atol=1e-9)


def test_a_cropped_camera_shows_the_same_rays():
    camera = through(LENSES["webcam"])
    k = camera.intrinsics - [[0, 0, 7], [0, 0, 4], [0, 0, 0]]
    cropped = Camera(k, camera.world_from_cam, 50, 45, camera.lens)
    points, _ = points_seen(camera)
    np.testing.assert_allclose(project(points, cropped)[0], project(points, camera)[0] - [7, 4], atol=1e-9)


@every_lens
def test_a_reprojection_equals_that_of_the_unprojected_points(lens):
    camera, workspace = through(lens, elevation=60), Workspace()
    depth = np.random.default_rng(0).uniform(0.5, 0.9, (60, 60))
    cells = np.stack([unproject(depth, camera)[..., axis] for axis in range(2)], axis=-1).reshape(-1, 2)
    cells = ((cells - workspace.center) / workspace.size + 0.5) * 24
    heights = unproject(depth, camera)[..., 2].ravel()
    buffer = zbuffer_from_depth(depth, camera, workspace, 24, np.inf)
    reference = np.full((24, 24), -np.inf)
    for (row, column), height in zip(np.floor(cells).astype(int), heights, strict=True):
        if 0 <= row < 24 and 0 <= column < 24:
            reference[row, column] = max(reference[row, column], height)
    np.testing.assert_allclose(buffer.height, np.where(np.isfinite(reference), reference, 0), atol=1e-6)


def pattern(x, y):
    """A smooth colour pattern on the table."""
    waves = [np.sin(25 * x), np.cos(30 * y), np.sin(20 * (x + y))]
    return (127.5 + 120 * np.stack(waves, axis=-1)).round().astype(np.uint8)


def photograph(camera):
    """Colour and depth of the table with the pattern, as the camera's lens shows it."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    ideal = to_ideal(np.stack([u, v], axis=-1).astype(float), camera)
    rays = np.concatenate([(ideal - camera.intrinsics[:2, 2]) / [camera.fx, camera.fy], np.ones((*u.shape, 1))], -1)
    directions = rays @ camera.world_from_cam[:3, :3].T
    depth = -camera.position[2] / directions[..., 2]
    points = camera.position + depth[..., None] * directions
    return Frame(pattern(points[..., 0], points[..., 1]), depth.astype(np.float32), camera, Workspace())


@every_lens
def test_a_distorted_and_an_undistorted_image_give_the_same_warp(lens):
    view, camera = make_view("persp", size=48, gripper=False), make_camera(elevation=70, size=240)
    photo = photograph(replace(camera, lens=lens))
    straight, distorted, ignored = (
        view.render(frame)["persp"].astype(int) for frame in (photograph(camera), photo, replace(photo, camera=camera))
    )
    difference = np.abs(straight - distorted).mean()
    assert difference < 0.6
    assert np.abs(straight - ignored).mean() > 3 * difference


@every_lens
def test_a_distorted_and_an_undistorted_image_give_the_same_reprojection(lens):
    """A cell shows the pattern anywhere within it, so that colours differ by at most its slope over one cell."""
    view, camera = make_view("reproj", size=48, clip="none"), make_camera(elevation=70, size=240)
    straight, distorted = (view.render(photograph(each)) for each in (camera, replace(camera, lens=lens)))
    slope = 120 * 20 * np.sqrt(2) * Workspace().size / 48
    assert np.abs(straight["reproj"].astype(int) - distorted["reproj"]).max() < np.sqrt(2) * slope + 1
    np.testing.assert_allclose(straight["reproj_height"], distorted["reproj_height"], atol=1e-6)


@pytest.mark.parametrize("lens", [Lens(PLUMB_BOB, (0.0,) * 5), Lens(RATIONAL, (0.0,) * 8)])
def test_a_lens_that_distorts_nothing_is_none(lens):
    camera = make_camera(size=60)
    assert replace(camera, lens=lens).lens is None
    depth = plane_depth(camera)
    np.testing.assert_array_equal(unproject(depth, replace(camera, lens=lens)), unproject(depth, camera))
    assert lens_from_coefficients(None, lens.coefficients) is None


def test_an_equidistant_lens_of_zeros_distorts_as_in_opencv():
    lens = lens_from_coefficients("equidistant", [0, 0, 0, 0])
    assert lens.distort([np.tan(0.5), 0.0])[0] == pytest.approx(0.5)
    assert lens_from_coefficients("equidistant", []) is None
    assert lens_from_coefficients("plumb_bob", [0, 0, 0, 0]) is None


@every_lens
def test_a_stored_lens_is_read_back(lens):
    again = stored_lens(lens.stored().astype(np.float32))
    assert again.model == lens.model
    np.testing.assert_allclose(again.stored(), lens.stored(), rtol=1e-6)
    camera = make_camera(size=60)
    numbers = camera.intrinsics, camera.world_from_cam, 60, 60
    assert stored_camera(*numbers, lens.stored()) is stored_camera(*numbers, lens.stored())
    assert stored_camera(*numbers, np.zeros(9)) is stored_camera(*numbers)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        (np.zeros(8), "has 9 numbers, got 8"),
        ([4.0, *[0.1] * 8], "starts with its model, 0 none, 1 plumb_bob"),
        ([0.0, *[0.1] * 8], "starts with its model"),
        ([1.0, *[0.1] * 8], "a stored plumb_bob lens has 5 coefficients, then zeros"),
        ([2.0, np.nan, *[0.1] * 7], "must be finite"),
    ],
)
def test_invalid_stored_lenses_are_rejected(numbers, message):
    with pytest.raises(CalibrationError, match=message):
        stored_lens(np.array(numbers))


@pytest.mark.parametrize(
    "lens",
    [
        Lens(PLUMB_BOB, (-1.5, 0, 0, 0)),
        Lens(RATIONAL, (-1.5, 0, 0, 0, 0, 0.1, 0, 0)),
        Lens(EQUIDISTANT, (-3.0, 0, 0, 0)),
    ],
)
def test_a_lens_that_folds_back_inside_the_image_is_refused(lens):
    with pytest.raises(CalibrationError, match=r"beyond which it folds back, and the 60 x 60 image is larger"):
        through(lens)


@every_lens
def test_what_lies_far_outside_of_the_image_stays_outside(lens):
    """A polynomial that folds back would draw points from outside into the image."""
    camera = through(lens)
    far = np.geomspace(0.6, 1e4, 200)[:, None] * [[1.0, 0.3]]
    in_camera = np.column_stack([far, np.ones(len(far))])
    pixels, _ = project(in_camera @ camera.world_from_cam[:3, :3].T + camera.position, camera)
    assert pixels[:, 0].min() > 59.5
