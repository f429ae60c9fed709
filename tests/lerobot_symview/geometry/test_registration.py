"""Depth from a sensor of its own, registered to colour."""

from dataclasses import replace

import numpy as np
import pytest

from lerobot_symview import reproject
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera, DepthSensor, invert_rigid, project, stored_camera, unproject
from lerobot_symview.geometry.lens import PLUMB_BOB, Lens
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.geometry.registration import LENS_OVERLAP, OVERLAP, register_depth
from lerobot_symview.geometry.visibility import table_rays
from lerobot_symview.geometry.workspace import Workspace
from symview_sim.settings import EnvSettings
from tests.helpers.cameras import make_camera, plane_depth

HEIGHT, WIDTH = 60, 80
LENS = Lens(PLUMB_BOB, (-0.2, 0.05, 0.001, -0.002, 0.0))


def placed(x=0.0, y=0.0, z=0.0, turn_deg=0.0):
    """Return color_from_depth: a translation, and a turn about the optical axis."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


def camera_with_sensor(color_from_depth, focal=40.0, lens=None):
    k = np.array([[60.0, 0, 39.5], [0, 60.0, 29.5], [0, 0, 1]])
    sensor = DepthSensor(np.array([[focal, 0, 31.5], [0, focal, 23.5], [0, 0, 1]]), color_from_depth)
    return Camera(k, make_camera().world_from_cam, HEIGHT, WIDTH, lens, sensor)


def sensor_depth(camera, shape=(48, 64), height=0.0):
    return plane_depth(camera.depth_camera(*shape), height).astype(np.float32)


def slow_registration(depth, camera):
    """Reference implementation: corner by corner through world points, and all pixels of the image for each square."""
    sensor = camera.depth_camera(*depth.shape)
    result = np.zeros((camera.height, camera.width), np.float32)
    v, u = np.mgrid[: camera.height, : camera.width]
    for (row, column), d in np.ndenumerate(depth):
        if not (np.isfinite(d) and d > 0):
            continue
        corners = [(column + a, row + b, 1.0) for a, b in ((0, 0), (-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5))]
        points = d * np.linalg.solve(sensor.intrinsics, np.transpose(corners)).T
        (_, *edges), distances = project(points @ sensor.world_from_cam[:3, :3].T + sensor.position, camera)
        if (distances <= 0).any():
            continue
        overlap = OVERLAP if camera.lens is None else LENS_OVERLAP
        low, high = np.min(edges, axis=0) - overlap, np.max(edges, axis=0) + overlap
        covered = (u >= low[0]) & (u < high[0]) & (v >= low[1]) & (v < high[1])
        nearer = covered & ((result == 0) | (distances[0] < result))
        result[nearer] = distances[0]
    return result


@pytest.mark.parametrize("lens", [None, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("focal", [18.0, 40.0], ids=["boxes of 3 and 4 pixels", "boxes of 1 and 2 pixels"])
@pytest.mark.parametrize("color_from_depth", [placed(0.015), placed(-0.02, 0.01, 0.005, 3.0), placed(turn_deg=180.0)])
def test_registration_equals_the_slow_reference(color_from_depth, focal, lens):
    camera = camera_with_sensor(color_from_depth, focal, lens)
    depth = sensor_depth(camera)
    depth[10:20, 20:40] -= 0.15
    depth[30] = 0
    registered, expected = register_depth(depth, camera), slow_registration(depth, camera)
    assert registered.dtype == np.float32
    assert (expected > 0).mean() > 0.7
    # Through a lens two corners are moved, not four: some boxes end a pixel earlier, where their neighbour's depth is.
    same = np.isclose(registered, expected, rtol=1e-5 if lens is None else 0.03)
    fewest_same, fewest_covered = (0.999, 0.999) if lens is None else {18.0: (0.97, 0.98), 40.0: (0.98, 0.997)}[focal]
    assert same.mean() > fewest_same
    assert (registered > 0)[expected > 0].mean() > fewest_covered


@pytest.mark.parametrize("lens", [None, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("value", [1e-40, 3e38, np.finfo(np.float32).max])
def test_depth_beyond_all_numbers_of_pixels_is_not_drawn(value, lens):
    """Its boxes are infinite: their edges, and the indices of their pixels, are no numbers."""
    camera = camera_with_sensor(placed(0.015), 5.0, lens)
    depth = sensor_depth(camera)
    expected = register_depth(np.where(np.arange(64) < 32, 0, depth).astype(np.float32), camera)
    depth[:, :32] = value
    assert 0.2 < (expected > 0).mean() < 0.8
    registered = register_depth(depth, camera)
    np.testing.assert_array_equal(registered[expected > 0], expected[expected > 0])
    assert not ((registered > 0) & (registered < 1e30) & (expected == 0)).any()


def test_an_aligned_sensor_changes_nothing():
    color = make_camera()
    camera = replace(color, depth_sensor=DepthSensor(color.intrinsics, np.eye(4)))
    depth = plane_depth(color).astype(np.float32)
    depth[3:9, 4:20] = 0
    np.testing.assert_array_equal(register_depth(depth, camera), depth)


@pytest.mark.parametrize("focal", [20.0, 40.0, 80.0], ids=["coarser", "similar", "finer"])
def test_a_plane_has_its_depth_in_the_colour_camera_and_no_holes(focal):
    camera = camera_with_sensor(placed(0.01, -0.005, 0.003, 1.0), focal)
    shape = (round(48 * focal / 40), round(64 * focal / 40))
    k = camera.depth_sensor.intrinsics.copy()
    k[:2, 2] = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    camera = replace(camera, depth_sensor=replace(camera.depth_sensor, intrinsics=k))
    registered, expected = register_depth(sensor_depth(camera, shape), camera), plane_depth(camera)
    inside = np.s_[8:-8, 12:-12]
    assert (registered[inside] > 0).all()
    # A pixel of depth covers focal_color / focal_depth pixels of colour, over which a tilted plane changes.
    np.testing.assert_allclose(registered[inside], expected[inside], rtol=0.03 * 40 / focal)


def test_the_nearest_surface_hides_the_others():
    """The sensor sees beside the box what the colour camera sees behind it."""
    camera = camera_with_sensor(placed(0.1))
    depth = np.full((48, 64), 1.0, np.float32)
    depth[:, 20:30] = 0.5
    registered = register_depth(depth, camera)
    columns = 60 / 40 * (np.array([20, 30]) - 0.5 - 31.5) + 60 * 0.1 / 0.5 + 39.5
    box = np.arange(WIDTH)[(np.arange(WIDTH) >= columns[0]) & (np.arange(WIDTH) < columns[1])]
    assert (registered[5:-5, box] == 0.5).all()
    assert set(np.unique(registered)) == {0.0, 0.5, 1.0}


def test_invalid_depth_and_points_behind_the_camera_are_left_out():
    camera = camera_with_sensor(placed(z=-0.3))
    depth = np.full((48, 64), 0.2, np.float32)
    depth[0], depth[1], depth[2], depth[3] = 0, np.nan, np.inf, -1
    assert not register_depth(depth, camera).any()  # 0.2 m before the sensor is behind the colour camera


def test_depth_of_another_place_gives_the_view_of_aligned_depth():
    """Rendered twice: from the colour camera, and from a depth sensor 2.4 cm beside it with a wider lens."""
    color_spec = CameraSpec(height=120, width=160)
    sensor_spec = replace(color_spec, azimuth_deg=2.0, fov_deg=60.0)
    images = {}
    for name, spec in (("color", color_spec), ("sensor", sensor_spec)):
        env = EnvSettings(camera=spec).make()
        observation, _ = env.reset(seed=3)
        images[name] = (env.cameras["side"], observation["pixels"]["side"], observation["images.side_depth"][0])
        env.close()
    (color, rgb, aligned), (sensor, _, depth) = images["color"], images["sensor"]
    camera = replace(
        color, depth_sensor=DepthSensor(sensor.intrinsics, invert_rigid(color.world_from_cam) @ sensor.world_from_cam)
    )
    registered = register_depth(depth, camera)
    both = (registered > 0) & (aligned > 0)
    assert both.mean() > 0.95
    errors = np.abs(registered - aligned)[both]
    assert np.median(errors) < 0.003
    assert (errors < 0.02).mean() > 0.95  # the rest are edges, which move by a pixel of depth
    views = [reproject(rgb, one, place, Workspace(), size=76) for one, place in ((aligned, color), (depth, camera))]
    assert (np.abs(views[0].height - views[1].height) < 0.01).mean() > 0.9
    shift = np.abs(views[0].rgb.astype(int) - views[1].rgb).mean()
    wrong = reproject(rgb, depth, color, Workspace(), size=76)
    assert shift < 0.5 * np.abs(views[0].rgb.astype(int) - wrong.rgb).mean()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"intrinsics": np.zeros((3, 3))}, "focal lengths must be positive"),
        ({"color_from_depth": placed(14.8)}, r"translation of 14\.8 m: is it in millimetres"),
        ({"color_from_depth": np.diag([1.0, 1, -1, 1])}, "left-handed"),
        ({"color_from_depth": np.eye(3)}, r"color_from_depth must have shape \(4, 4\)"),
    ],
)
def test_an_impossible_sensor_is_refused(change, message):
    arguments = {"intrinsics": np.array([[40.0, 0, 31.5], [0, 40, 23.5], [0, 0, 1]]), "color_from_depth": np.eye(4)}
    with pytest.raises(CalibrationError, match=message):
        DepthSensor(**arguments | change)


def test_a_sensor_of_another_image_size_is_refused():
    with pytest.raises(CalibrationError, match=r"depth sensor does not fit its images: .*outside the 20 x 20 image"):
        register_depth(np.ones((20, 20), np.float32), camera_with_sensor(np.eye(4)))
    with pytest.raises(CalibrationError, match="no depth sensor"):
        register_depth(np.ones((48, 64), np.float32), make_camera())


def test_a_stored_sensor_is_the_same_object_for_equal_numbers():
    camera = camera_with_sensor(placed(0.015))
    sensor = camera.depth_sensor
    numbers = (camera.intrinsics.ravel(), camera.world_from_cam.ravel(), HEIGHT, WIDTH, None)
    stored = stored_camera(*numbers, sensor.intrinsics.ravel(), sensor.color_from_depth.ravel())
    assert stored is stored_camera(*numbers, sensor.intrinsics.ravel(), sensor.color_from_depth.ravel())
    assert stored is not stored_camera(*numbers)
    np.testing.assert_array_equal(stored.depth_sensor.color_from_depth, sensor.color_from_depth)
    np.testing.assert_array_equal(unproject(np.ones((48, 64)), stored.depth_camera(48, 64)).shape, (48, 64, 3))


def test_table_rays_of_the_sensor_lie_on_the_table():
    camera = camera_with_sensor(placed(0.02, turn_deg=2.0))
    _, depth, _ = table_rays(camera.depth_camera(48, 64), Workspace())
    points = unproject(register_depth(depth.astype(np.float32), camera), camera)
    seen = register_depth(depth.astype(np.float32), camera) > 0
    assert np.abs(points[seen][:, 2]).max() < 0.03
    assert abs(np.median(points[seen][:, 2])) < 0.001


def test_a_stored_sensor_needs_both_matrices():
    with pytest.raises(CalibrationError, match="belong together"):
        stored_camera(np.diag([60.0, 60, 1]) + [[0, 0, 9], [0, 0, 9], [0, 0, 0]], make_camera().world_from_cam, 20, 20,
                      depth_intrinsics=np.eye(3))  # fmt: skip
