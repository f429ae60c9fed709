import os

import numpy as np
import pytest

from lerobot_symview.geometry.camera import project, unproject
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.views import Frame, make_view
from symview_sim import bullet
from symview_sim.control import COARSE
from symview_sim.rendering import render
from symview_sim.robots import ROBOTS
from symview_sim.scene import Scene
from symview_sim.settings import EnvSettings
from tests.helpers.cameras import make_camera

BOX = np.array([0.30, 0.24, 0.04])


@pytest.fixture(scope="module")
def scene():
    from lerobot_symview.geometry.workspace import Workspace

    scene = Scene(ROBOTS["panda"], Workspace(), COARSE)
    scene.reset(np.array([0.3, 0.0, 0.24]), 0.0)
    scene.add_box(BOX, 0.0, 1.0, (0.9, 0.1, 0.1), np.array([0.45, 0.0, 0.02]), 0.0)
    return scene


@pytest.mark.parametrize(("elevation", "azimuth"), [(45, 0), (20, 50), (75, 200), (90, 0)])
def test_depth_unprojects_to_the_known_surfaces(scene, elevation, azimuth):
    """A half-pixel error in the renderer's pixel centres shows as 0.6 mm or more here."""
    camera = make_camera(elevation, azimuth)
    with scene.arm.hidden():
        rgb, depth, _ = render(scene.client, camera)
    points = unproject(depth, camera)
    inside = (np.abs(points[..., :2] - [0.45, 0.0]) < BOX[:2] / 2 - 0.01).all(axis=-1)
    top = inside & (np.abs(points[..., 2] - 0.04) < 0.01)
    assert top.sum() > 500
    assert (rgb[top][:, 0] > 2 * rgb[top][:, 1]).all()
    assert points[top][:, 2].mean() == pytest.approx(0.04, abs=2e-4)
    table = (depth > 0) & ~(np.abs(points[..., :2] - [0.45, 0.0]) < BOX[:2] / 2 + 0.02).all(axis=-1)
    np.testing.assert_allclose(points[table][:, 2], 0.0, atol=1e-6)


def test_edges_appear_where_they_project(scene):
    camera = make_camera(45.0)
    with scene.arm.hidden():
        rgb, _, _ = render(scene.client, camera)
    red = rgb[..., 0].astype(int) > 2 * rgb[..., 1].astype(int)
    near = np.array([[0.6, y, z] for y in (-0.12, 0.12) for z in (0.0, 0.04)])
    pixels, _ = project(near, camera)
    columns = np.flatnonzero(red[int(pixels[:, 1].mean())])
    assert columns[0] == pytest.approx(pixels[:, 0].min(), abs=1.0)
    assert columns[-1] == pytest.approx(pixels[:, 0].max(), abs=1.0)


def test_above_the_horizon_depth_is_invalid(scene):
    _, depth, _ = render(scene.client, make_camera(10.0, 180.0))
    assert (depth[0] == 0).any()
    assert (depth[-1] > 0).all()


class TupleClient:
    """A client as PyBullet offers it without numpy support: images are flat tuples of Python numbers."""

    def __init__(self, client):
        self._client = client

    def __getattr__(self, name):
        return getattr(self._client, name)

    def getCameraImage(self, *arguments, **options):  # noqa: N802
        width, height, *images = self._client.getCameraImage(*arguments, **options)
        return width, height, *(tuple(image.ravel().tolist()) for image in images)


@pytest.mark.parametrize("labelled", [False, True])
def test_a_pybullet_without_numpy_renders_bit_identical_images(scene, labelled):
    camera = make_camera(45.0)
    expected = render(scene.client, camera, labelled)
    result = render(TupleClient(scene.client), camera, labelled)
    for one, other in zip(result, expected, strict=True):
        assert (one is None) == (other is None)
        if other is not None:
            assert (one.dtype, one.shape) == (other.dtype, other.shape)
            assert one.tobytes() == other.tobytes()


def test_a_pybullet_without_numpy_is_reported_once_with_the_remedy(monkeypatch, caplog):
    monkeypatch.delenv(bullet.WARNED, raising=False)
    bullet.warn_without_numpy()
    assert not caplog.records  # this build has numpy support
    monkeypatch.setattr(bullet.pybullet, "isNumpyEnabled", lambda: 0)
    bullet.warn_without_numpy()
    bullet.warn_without_numpy()
    (record,) = caplog.records
    assert bullet.REBUILD in record.getMessage()
    assert os.environ[bullet.WARNED]  # processes that are started from here stay silent
    monkeypatch.delenv(bullet.WARNED)
    monkeypatch.setattr(bullet.multiprocessing, "parent_process", lambda: object())
    bullet.warn_without_numpy()
    assert len(caplog.records) == 1


def test_hiding_the_arm_removes_it_and_brings_it_back(scene):
    camera = make_camera(45.0)
    before = render(scene.client, camera)[1]
    with scene.arm.hidden():
        without = render(scene.client, camera)[1]
    np.testing.assert_array_equal(render(scene.client, camera)[1], before)
    assert (without != before).mean() > 0.005


@pytest.mark.parametrize("task", ["block_stacking", "block_in_bowl", "drawer_opening"])
def test_a_camera_straight_above_reprojects_to_the_oracles_image(task):
    """Nothing is hidden from it but what leans outwards, so the view is the oracle's image up to its edges."""
    camera = CameraSpec(height=304, width=304, elevation_deg=90.0, distance=1.5, fov_deg=24.0, sees_robot=False)
    env = EnvSettings(task=task, camera=camera, oracle=True).make()
    observation, _ = env.reset(seed=3)
    rgb, depth = observation["pixels"]["side"], observation["images.side_depth"][0]
    frame = Frame(rgb, depth, env.cameras["side"], env.workspace)
    images = make_view("reproj", size=304, clip="none").render(frame)
    oracle = observation["pixels"]["top"]
    different = np.abs(images["reproj"].astype(int) - oracle).max(axis=-1) > 24
    assert different.mean() < 0.03
    height = env.cameras["top"].position[2] - observation["images.top_depth"][0]
    assert (np.abs(images["reproj_height"] - height) > 0.004).mean() < 0.03
    assert height.max() > 0.03
    env.close()
