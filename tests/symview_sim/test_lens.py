"""Simulated cameras with a lens: where known points appear, the views of such images, and what is recorded."""

from dataclasses import replace

import numpy as np
import pytest

from lerobot_policy_symview.rl.rollouts import simulator_config
from lerobot_symview import keys
from lerobot_symview.errors import CalibrationError, OptionError
from lerobot_symview.geometry.camera import project, unproject
from lerobot_symview.geometry.lens import EQUIDISTANT, Lens
from lerobot_symview.geometry.placement import CameraSpec, described
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import Frame, make_view
from symview_sim.camera_rig import CameraImages
from symview_sim.generate import GenerateConfig, RecordedEnv, plan_recording
from symview_sim.lens import SAMPLES, pinhole_camera, through_lens
from symview_sim.settings import EnvSettings, NewDataset
from symview_sim.simulators import Reset, Simulators
from tests.helpers.cameras import make_camera
from tests.helpers.policies import make_config

WEBCAM = (-0.3, 0.1, 0.0, 0.0)
LENSES = {
    "webcam": CameraSpec(distortion=WEBCAM),
    "pincushion, tangential": CameraSpec(distortion=(0.2, 0.05, 0.004, -0.003, 0.01)),
    "rational": CameraSpec(distance=0.55, distortion=(0.2, 0.05, 0.0, 0.0, 0.01, 0.4, 0.1, 0.02)),
    "fisheye": CameraSpec(fov_deg=90.0, distance=0.5, distortion=(0.05, 0.0, 0.0, 0.0), distortion_model=EQUIDISTANT),
}
PINHOLE = CameraSpec(distance=0.55)  # the workspace reaches the image's corners, where a lens shows most
SEEN = replace(PINHOLE, distortion=WEBCAM)
IGNORED = replace(SEEN, distortion_known=False)


@pytest.mark.parametrize("spec", LENSES.values(), ids=LENSES)
def test_known_points_appear_where_the_camera_projects_them(spec):
    """Discs that a pinhole camera draws around the projections of points; the lens moves their centres."""
    camera = spec.place(Workspace())
    steps = np.linspace(-0.18, 0.18, 4)
    points = np.array([[0.45 + x, y, 0.02] for x in steps for y in steps])

    def draw(wide):
        assert wide.lens is None
        labels = np.zeros((wide.height, wide.width), dtype=np.uint8)
        v, u = np.indices(labels.shape)
        pixels, depth = project(points, wide)
        for label, (column, row) in enumerate(pixels, start=1):
            labels[np.hypot(u - column, v - row) < 3 * SAMPLES] = label
        return CameraImages(np.dstack([labels] * 3), np.append(0, depth)[labels].astype(np.float32), labels)

    image = through_lens(draw, camera)
    pixels, depth = project(points, camera)
    without, _ = project(points, replace(camera, lens=None))
    assert np.abs(without - pixels).max() > 1.0
    for label, (column, row) in enumerate(pixels, start=1):
        rows, columns = np.nonzero(image.labels == label)
        assert len(rows) > 10
        np.testing.assert_allclose((columns.mean(), rows.mean()), (column, row), atol=0.3)
        assert image.depth[rows, columns] == pytest.approx(depth[label - 1])
    np.testing.assert_array_equal(image.rgb, np.dstack([image.labels] * 3))


def seen(camera, seed=0):
    """A frame of the simulator as its calibration states it, and where the camera truly is."""
    env = EnvSettings("block_picking", camera=camera, segmentation=True).make()
    observation, _ = env.reset(seed=seed)
    stated = replace(env.cameras["side"], lens=camera.lens if camera.distortion_known else None)
    assert ("camera.side.distortion" in observation) == camera.states_lens
    assert observation.keys() == env.observation_space.keys()
    rgb, depth = observation["pixels"]["side"], observation["images.side_depth"][0]
    labels = observation["pixels"]["side_segmentation"][..., 0]
    env.close()
    return Frame(rgb, depth, stated, Workspace(), observation["agent_pos"]), labels


def test_surfaces_are_where_they_are_if_the_calibration_knows_the_lens():
    """The table's depth is exact but for the shift to the nearest pixel; a calibration without the lens bends it."""
    worst, block = {}, {}
    for name, camera in {"pinhole": PINHOLE, "known": SEEN, "ignored": IGNORED}.items():
        frame, labels = seen(camera)
        points = unproject(frame.depth, frame.camera)
        inside = (np.abs(points[..., :2] - [0.45, 0.0]) < 0.2).all(axis=-1)
        worst[name] = np.abs(points[inside & (labels == 0)][:, 2]).max()
        top = points[labels == 2]
        block[name] = top[top[:, 2] > 0.035].mean(axis=0)
    assert worst["pinhole"] < 1e-6
    assert worst["known"] < 0.0015
    assert worst["ignored"] > 2 * worst["known"]
    assert block["known"] == pytest.approx(block["pinhole"], abs=0.003)


@pytest.mark.parametrize("name", ["reproj", "persp"])
def test_the_view_through_a_known_lens_is_that_of_the_pinhole_image(name):
    """Up to the edges of tiles and block, which move by a part of a pixel; elsewhere colours are the same."""
    views = {}
    for kind, camera in {"pinhole": PINHOLE, "known": SEEN, "ignored": IGNORED}.items():
        frame, _ = seen(camera)
        views[kind] = make_view(name).render(frame)[name].astype(int)
    differing = {kind: (np.abs(views[kind] - views["pinhole"]).max(axis=-1) > 8).mean() for kind in views}
    assert differing["known"] < 0.7 * differing["ignored"]
    assert differing["known"] < 0.06


def test_a_lens_does_not_change_the_physics_nor_the_labels():
    labels = [seen(camera)[1] for camera in (PINHOLE, SEEN, IGNORED)]
    np.testing.assert_array_equal(labels[1], labels[2])
    assert set(np.unique(labels[1])) == set(np.unique(labels[0]))


def test_simulators_report_the_lens_to_policies_of_points_and_make_views_with_it():
    config = make_config(method="voxel_equi")
    names = [simulator_config(config, EnvSettings("block_picking", camera=camera)).names for camera in (SEEN, IGNORED)]
    assert set(names[0]) - set(names[1]) == {keys.distortion("side")}
    config = simulator_config(make_config(method="reproj_equi"), EnvSettings("block_picking", camera=SEEN))
    frame, _ = seen(SEEN)
    with Simulators(config, 1) as simulators:
        simulators.send(0, Reset(0))
        observation = simulators.receive(0).observation
    expected = config.views[0].make().render(frame)["reproj"]
    assert (observation[keys.view("side", "reproj")] != expected).mean() < 0.001  # float32 calibration


def test_a_recording_declares_the_lens_that_the_calibration_states(tmp_path):
    plans = {
        name: plan_recording(GenerateConfig(NewDataset("a/b", tmp_path), RecordedEnv(camera=camera)), tmp_path)
        for name, camera in {"known": SEEN, "ignored": IGNORED, "pinhole": PINHOLE}.items()
    }
    declared = {name: keys.distortion("side") in plan.features for name, plan in plans.items()}
    assert declared == {"known": True, "ignored": False, "pinhole": False}
    cameras = {name: plan.description()["env"]["camera"] for name, plan in plans.items()}
    assert cameras["known"]["distortion"] == list(WEBCAM)
    assert cameras["ignored"].keys() - cameras["pinhole"].keys() == {
        "distortion", "distortion_model", "distortion_known"
    }  # fmt: skip
    assert described(CameraSpec(distortion_known=False)) == described(CameraSpec())


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"distortion": (0.1,)}, "distortion: the lens model plumb_bob has 4 or 5 coefficients, got 1"),
        ({"distortion": (0.1, 0, 0, 0), "distortion_model": "tube"}, "distortion: the lens model 'tube' is not"),
        ({"distortion_model": "plumb_bob"}, r"distortion_model=plumb_bob needs distortion, got \(\)"),
    ],
)
def test_an_invalid_lens_is_refused(fields, message):
    with pytest.raises(OptionError, match=message):
        CameraSpec(**fields)


def test_a_lens_too_wide_to_be_rendered_is_refused_at_once():
    lens = {"distortion": (0.0, 0.0, 0.0, 0.0), "distortion_model": EQUIDISTANT}
    focal = 69.0  # 89 degrees in the corners
    wide = CameraSpec(intrinsics=(focal, 0, 75.5, 0, focal, 75.5, 0, 0, 1), distance=0.4, **lens)
    assert wide.lens == Lens(EQUIDISTANT, (0.0,) * 4)
    with pytest.raises(CalibrationError, match=r"up to \d+ degrees from the optical axis, for which the simulator"):
        EnvSettings("block_picking", camera=wide).make()


def test_a_camera_without_a_lens_is_drawn_as_it_is():
    camera = make_camera(size=96)
    assert pinhole_camera(camera) is camera
