"""A MuJoCo scene of known boxes, rendered by cameras of any place and intrinsics."""

import mujoco
import numpy as np
import pytest

from lerobot_symview.geometry.camera import Camera, invert_rigid, project, unproject
from lerobot_symview.runtime.cli import CommandError
from symview_sim.worlds import rendering
from symview_sim.worlds.base import turned
from symview_sim.worlds.rendering import MujocoRenderer
from tests.helpers.cameras import make_camera

MODEL_FROM_WORLD = invert_rigid(turned(-90.0, (0.1, -0.2, -0.4)))  # the model's table is 0.4 m high, and turned
BOX, CENTER = np.array([0.30, 0.24, 0.04]), np.array([0.45, 0.0, 0.02])  # in the world's frame


@pytest.fixture(scope="module")
def scene():
    middle = (MODEL_FROM_WORLD @ [*CENTER, 1.0])[:3]
    size = np.abs(MODEL_FROM_WORLD[:3, :3] @ BOX) / 2
    text = f"""
    <mujoco><worldbody><light pos="0 0 3" dir="0 0 -1" directional="true"/>
      <geom type="plane" size="5 5 .1" pos="0 0 .4" rgba=".2 .2 .9 1"/>
      <geom type="box" size="{" ".join(map(str, size))}" pos="{" ".join(map(str, middle))}" rgba=".9 .1 .1 1"/>
    </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = MujocoRenderer(model, 160, 200)
    yield lambda camera: renderer.render(data, camera, MODEL_FROM_WORLD)
    renderer.close()


def oblong(camera):
    """The camera with a principal point off the centre, unequal focal lengths and another size."""
    intrinsics = camera.intrinsics.copy()
    intrinsics[0, 0] *= 1.1
    intrinsics[:2, 2] += [9.5, -4.0]
    return Camera(intrinsics, camera.world_from_cam, 120, 160)


@pytest.mark.parametrize("change", [lambda camera: camera, oblong], ids=["square", "oblong"])
@pytest.mark.parametrize(("elevation", "azimuth"), [(45, 0), (20, 50), (75, 200), (90, 0)])
def test_depth_unprojects_to_the_known_surfaces(scene, elevation, azimuth, change):
    camera = change(make_camera(elevation, azimuth))
    rgb, depth, labels = scene(camera)
    assert labels is None
    points = unproject(depth, camera)
    offset = np.abs(points[..., :2] - CENTER[:2])
    top = (offset < BOX[:2] / 2 - 0.01).all(axis=-1)
    assert top.sum() > 500
    np.testing.assert_allclose(points[top][:, 2], 0.04, atol=2e-5)
    assert (rgb[top][:, 0] > 2 * rgb[top][:, 2]).all()
    table = (depth > 0) & (depth < 3) & ~(offset < BOX[:2] / 2 + 0.02).all(axis=-1)
    np.testing.assert_allclose(points[table][:, 2], 0.0, atol=2e-4)


@pytest.mark.parametrize("change", [lambda camera: camera, oblong], ids=["square", "oblong"])
def test_edges_appear_where_they_project(scene, change):
    camera = change(make_camera(90.0))
    rgb, _, _ = scene(camera)
    red = rgb[..., 0].astype(int) > 2 * rgb[..., 2].astype(int)
    corners = np.array([[*(CENTER[:2] + [sx, sy] * BOX[:2] / 2), 0.04] for sx in (-1, 1) for sy in (-1, 1)])
    pixels, _ = project(corners, camera)
    rows, columns = np.nonzero(red)
    assert [columns.min(), rows.min()] == np.ceil(pixels.min(axis=0)).tolist()  # pixels whose centres are inside
    assert [columns.max(), rows.max()] == np.floor(pixels.max(axis=0)).tolist()


def test_without_a_way_to_draw_the_error_names_the_remedy(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr("mujoco.egl.GLContext", lambda width, height: 1 / 0)
    with pytest.raises(CommandError, match=r"by egl: division by zero; install .*libegl1.*MUJOCO_GL=osmesa"):
        rendering._gl_context(8, 8)
