"""Views that merge several cameras: in datasets, in a policy's processor, in environments and in simulators."""

import logging
import shutil
import sys
from dataclasses import replace

import draccus
import numpy as np
import pytest
import torch
import yaml
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets import LeRobotDataset, modify_features
from lerobot.envs.utils import preprocess_observation
from lerobot.scripts import lerobot_eval

from lerobot_policy_symview import SymviewEnvConfig, ViewsProcessorStep
from lerobot_policy_symview.rl.demonstrations import check_scene
from lerobot_symview import keys, reproject, warp_table
from lerobot_symview.calibration.file import Calibration, parse_calibration, plain_calibration
from lerobot_symview.datasets.add_views import add_views
from lerobot_symview.errors import CalibrationError, DatasetError, OptionError
from lerobot_symview.geometry.camera import stored_camera
from lerobot_symview.geometry.miscalibration import Miscalibration
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.flag_errors import FlagError
from lerobot_symview.views import ViewSpec, make_view
from symview_sim.camera_rig import named_features
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import EnvSettings, NewDataset
from symview_sim.simulators import Reset, SimulatorConfig, Simulators
from tests.helpers.datasets import images_of, rewrite_depth, views_config
from tests.helpers.training import train

CAMERAS = ["side", "left"]
SIDE, LEFT = CameraSpec(), CameraSpec("left", height=96, width=128, azimuth_deg=90.0)
SIZE = 76
VIEWS = [{"name": name, "size": SIZE, "cameras": CAMERAS} for name in ("reproj", "persp")]
OUTPUTS = [keys.view("side", output) for view in VIEWS for output in ViewSpec.parse(view).make().outputs]
CALIBRATION = [key for name in CAMERAS for key in keys.calibration(name, ())]
FUSED = "--policy.view={name: reproj, cameras: [side, left]}"


@pytest.fixture(scope="module")
def two_cameras(tmp_path_factory):
    folder = tmp_path_factory.mktemp("two") / "recorded"
    env = RecordedEnv("block_pushing", camera=SIDE, more_cameras=(LEFT,), oracle=False)
    return generate(GenerateConfig(NewDataset("test/two", folder), env=env, num_episodes=2))


@pytest.fixture(scope="module")
def merged(two_cameras):
    return add_views(merging(two_cameras, two_cameras.with_name("merged")))


def merging(source, target, **options):
    return views_config(source, target, **({"views": VIEWS, "size": None} | options))


def observation(folder, index=0):
    """A frame of the dataset as a policy's processor gets it, without views."""
    item = LeRobotDataset("test/any", root=folder, depth_output_unit="m")[index]
    return {key: value[None] for key, value in item.items() if torch.is_tensor(value) and key not in OUTPUTS}


def calibrated(item, name):
    """The camera `name`, its image (H, W, 3) and its depth (H, W)."""
    rgb = (item[keys.rgb(name)][0] * 255).round().byte().permute(1, 2, 0).numpy()
    matrices = [item[key][0].numpy() for key in keys.calibration(name, ())]
    return rgb, item[keys.depth(name)][0, 0].numpy(), stored_camera(*matrices, *rgb.shape[:2])


def uint8(images):
    return np.rint(255 * np.asarray(images)).astype(np.uint8)


@pytest.mark.parametrize("index", [0, 6])
def test_stored_views_equal_the_library_and_the_processor(two_cameras, merged, index):
    item = observation(two_cameras, index)
    rgb, depth, cameras = zip(*(calibrated(item, name) for name in CAMERAS), strict=True)
    gripper = item[keys.STATE][0].numpy()
    expected = reproject(rgb, depth, cameras, Workspace(), gripper, size=SIZE)
    stored = {key: images_of(merged, key)[index] for key in OUTPUTS}
    np.testing.assert_array_equal(uint8(stored[keys.view("side", "reproj")]).transpose(1, 2, 0), expected.rgb)
    np.testing.assert_array_equal(stored[keys.view("side", "reproj_height")][0], expected.height)
    warped = warp_table(rgb, cameras, Workspace(), SIZE)
    np.testing.assert_array_equal(uint8(stored[keys.view("side", "persp")]).transpose(1, 2, 0), warped)
    online = ViewsProcessorStep(views=VIEWS).observation(item)
    for key, image in stored.items():
        np.testing.assert_array_equal(online[key][0].numpy(), image, err_msg=key)
    alone = reproject(rgb[0], depth[0], cameras[0], Workspace(), gripper, size=SIZE)
    assert expected.seen.mean() > alone.seen.mean()


def test_the_order_of_the_names_and_the_own_camera_among_them_do_not_matter(two_cameras):
    item = observation(two_cameras)
    pictures = [
        ViewsProcessorStep(views=[{"name": "reproj", "cameras": names}]).observation(item)[OUTPUTS[0]]
        for names in (["side", "left"], ["left", "side"], ["left"])
    ]
    assert torch.equal(pictures[0], pictures[1])
    assert torch.equal(pictures[0], pictures[2])


def test_a_calibration_file_of_both_cameras_gives_the_same_views(two_cameras, merged, tmp_path):
    """Offline, and online with the calibration that the result's policies store."""
    source = LeRobotDataset("test/two", root=two_cameras)
    item = observation(two_cameras)
    modify_features(source, remove_features=CALIBRATION, output_dir=tmp_path / "bare", repo_id="test/bare")
    cameras = {name: calibrated(item, name)[2] for name in CAMERAS}
    content = plain_calibration(Calibration(cameras))
    file = tmp_path / "cameras.yaml"
    file.write_text(yaml.safe_dump(content))
    result = add_views(merging(tmp_path / "bare", tmp_path / "derived", calibration=file))
    for key in [*OUTPUTS, *CALIBRATION]:
        np.testing.assert_array_equal(images_of(result, key), images_of(merged, key), err_msg=key)
    bare = {key: value for key, value in item.items() if key not in CALIBRATION}
    online = ViewsProcessorStep(views=VIEWS, calibration=content).observation(bare)
    for key in OUTPUTS:
        np.testing.assert_array_equal(online[key][0].numpy(), images_of(merged, key)[0], err_msg=key)
    content["cameras"].pop("left")
    file.write_text(yaml.safe_dump(content))
    with pytest.raises(CalibrationError, match="has no camera 'left'; it has side"):
        add_views(merging(tmp_path / "bare", tmp_path / "never", calibration=file))
    assert not list(tmp_path.glob("never*"))


def test_each_camera_has_its_own_unit_of_depth(two_cameras, merged, tmp_path):
    """Tenths of millimetres of one camera, metres of the other; the units are in the file, and online inferred."""
    item = observation(two_cameras)
    content = plain_calibration(Calibration({name: calibrated(item, name)[2] for name in CAMERAS}))
    content["cameras"]["left"]["depth_unit"] = 1e-4
    bare = {key: value for key, value in item.items() if key not in CALIBRATION}
    bare[keys.depth("left")] = (bare[keys.depth("left")] * 10_000).round()
    made = ViewsProcessorStep(views=VIEWS[:1], calibration=content).observation(bare)
    expected = images_of(merged, OUTPUTS[1])[0]
    assert np.abs(made[OUTPUTS[1]][0].numpy() - expected).mean() < 2e-4
    content["cameras"]["left"].pop("depth_unit")
    inferred = ViewsProcessorStep(views=VIEWS[:1], calibration=content).observation(bare)
    assert torch.equal(made[OUTPUTS[1]], inferred[OUTPUTS[1]])


def test_a_camera_may_be_missing_in_a_frame(two_cameras, caplog):
    """Its depth has no valid pixel, its image is black, or the observation has no image of it."""
    item = observation(two_cameras)
    alone = ViewsProcessorStep(views=[{"name": "reproj", "size": SIZE}, {"name": "persp", "size": SIZE}])
    of_left = ViewsProcessorStep(
        views=[{"name": name, "size": SIZE} for name in ("reproj", "persp")], camera="left"
    ).observation(item)
    expected = alone.observation(item)
    for lost in (
        item | {keys.depth("left"): torch.zeros(1, 1, 96, 128), keys.rgb("left"): torch.zeros(1, 3, 96, 128)},
        {key: value for key, value in item.items() if key not in (keys.rgb("left"), keys.depth("left"))},
    ):
        made = ViewsProcessorStep(views=VIEWS).observation(lost)
        for key in OUTPUTS:
            assert torch.equal(made[key], expected[key]), key
    assert "the observation has no observation.images.left: views are made without it" in caplog.text
    only_left = {key: value for key, value in item.items() if key not in (keys.rgb("side"), keys.depth("side"))}
    made = ViewsProcessorStep(views=VIEWS).observation(only_left)
    for key in OUTPUTS:
        assert torch.equal(made[key], of_left[key.replace("side", "left")]), key
    with pytest.raises(KeyError, match=r"need.*observation\.images\.side"):
        ViewsProcessorStep(views=[*VIEWS[:1], "persp"]).observation(only_left)
    with pytest.raises(KeyError, match=r"need \['observation.images.left_depth'\]"):
        ViewsProcessorStep(views=VIEWS).observation(
            {key: value for key, value in item.items() if key != keys.depth("left")}
        )


def test_frames_without_a_camera_in_a_dataset_show_the_other(two_cameras, tmp_path):
    shutil.copytree(two_cameras, tmp_path / "lossy")
    lossy = LeRobotDataset("test/two", root=tmp_path / "lossy", depth_output_unit="m")
    count = iter(range(len(lossy)))
    rewrite_depth(tmp_path / "lossy", keys.depth("left"), lambda depth: depth * (next(count) % 2 == 0))
    made = add_views(merging(tmp_path / "lossy", tmp_path / "made", views=VIEWS[:1]))
    alone = add_views(views_config(two_cameras, tmp_path / "alone", views=["reproj"]))
    both = [images_of(folder, OUTPUTS[0]) for folder in (made, alone)]
    equal = [np.array_equal(one, other) for one, other in zip(*both, strict=True)]
    assert equal == [index % 2 == 1 for index in range(len(equal))]


def test_contradicting_calibrations_are_reported(two_cameras, caplog):
    item = observation(two_cameras)
    caplog.set_level(logging.INFO)
    ViewsProcessorStep(views=VIEWS).observation(item)
    text = "cameras side, left measure heights that differ by more than 1 cm in"
    assert [record.levelname for record in caplog.records if text in record.message] == ["INFO"]
    caplog.clear()
    camera = calibrated(item, "left")[2]
    wrong = Miscalibration(position=0.04).stated(camera, np.random.default_rng(1))
    item[keys.world_from_cam("left")] = torch.from_numpy(wrong.world_from_cam).float().flatten()[None]
    ViewsProcessorStep(views=VIEWS[:1]).observation(item)
    assert [record.levelname for record in caplog.records if text in record.message] == ["WARNING"]


def test_environments_make_merged_views():
    config = SymviewEnvConfig(camera=SIDE, more_cameras=(LEFT,), views=VIEWS)
    env = config.create_envs(1)["block_picking"][0]
    item = preprocess_observation(env.reset(seed=0)[0])
    made = config.get_env_processors()[0](item)
    expected = ViewsProcessorStep(views=VIEWS).observation(item)
    env.close()
    for key in OUTPUTS:
        assert torch.equal(made[key], expected[key])
    with pytest.raises(FlagError, match=r"'reproj' merges left, but --env\.camera and --env.more_cameras are side"):
        SymviewEnvConfig(camera=SIDE, views=VIEWS)


def test_simulators_make_merged_views():
    settings = EnvSettings(camera=SIDE, more_cameras=(LEFT,))
    config = SimulatorConfig(settings, tuple(OUTPUTS), tuple(map(ViewSpec.parse, VIEWS)))
    with Simulators(config, 1) as one:
        one.send(0, Reset(3))
        made = one.receive(0).observation
    env = settings.make()
    raw = named_features(env.reset(seed=3)[0])
    env.close()
    cameras = [
        stored_camera(raw[keys.intrinsics(name)], raw[keys.world_from_cam(name)], *raw[keys.rgb(name)].shape[:2])
        for name in CAMERAS
    ]
    rgb, depth = ([raw[key(name)] for name in CAMERAS] for key in (keys.rgb, keys.depth))
    expected = reproject(rgb, [image[..., 0] for image in depth], cameras, Workspace(), raw[keys.STATE], size=SIZE)
    np.testing.assert_array_equal(made[OUTPUTS[0]], expected.rgb)


@pytest.mark.long
def test_lerobot_trains_and_evaluates_a_policy_on_a_merged_view(two_cameras, merged, tmp_path, monkeypatch):
    """From raw images and from stored views; the checkpoint keeps both cameras' calibration."""
    for name, folder, flags in (("raw", two_cameras, [FUSED]), ("stored", merged, [])):
        checkpoint = train(monkeypatch, folder, tmp_path / name, *flags)
        config = PreTrainedConfig.from_pretrained(checkpoint)
        assert config.view.options["cameras"] == CAMERAS
        assert [key for key in config.input_features if ".images." in key] == [
            key(camera) for camera in CAMERAS for key in (keys.rgb, keys.depth)
        ]
        assert list(parse_calibration(config.calibration).cameras) == CAMERAS
    command = [
        "lerobot-eval",
        f"--policy.path={checkpoint}",
        "--policy.device=cpu",
        "--env.type=symview",
        "--env.max_steps=2",
        "--env.more_cameras=[{name: left, azimuth_deg: 90, height: 96, width: 128}]",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        f"--output_dir={tmp_path / 'eval'}",
    ]
    monkeypatch.setattr(sys, "argv", command)
    lerobot_eval.main()
    assert (tmp_path / "eval" / "eval_info.json").is_file()


@pytest.mark.parametrize(
    ("cameras", "message"),
    [("", "must be a list of names"), (["a", "a"], "must differ, got a, a"), ([3], "must be a list of names")],
)
def test_wrong_camera_names_raise(cameras, message):
    with pytest.raises(OptionError, match=message):
        make_view("reproj", cameras=cameras)


def test_a_dataset_without_the_camera_is_refused(two_cameras, tmp_path):
    views = [{"name": "reproj", "cameras": ["side", "right"]}]
    with pytest.raises(DatasetError, match=r"lacks observation\.images\.right, observation\.images\.right_depth"):
        add_views(merging(two_cameras, tmp_path / "never", views=views))
    assert not list(tmp_path.glob("never*"))


def test_reinforcement_learning_needs_the_cameras_of_the_demonstrations(two_cameras):
    dataset = LeRobotDataset("test/two", root=two_cameras)
    env = EnvSettings("block_pushing", camera=SIDE)
    with pytest.raises(ValueError, match=r"view merges left: give --env\.more_cameras"):
        check_scene(dataset, env, "side", ["left"])
    moved = replace(env, more_cameras=(replace(LEFT, azimuth_deg=60.0),))
    with pytest.raises(ValueError, match=r"--env\.more_cameras: left\.azimuth_deg is 60\.0, the dataset has 90\.0"):
        check_scene(dataset, moved, "side", ["left"])
    check_scene(dataset, replace(env, more_cameras=(LEFT,)), "side", ["left"])


@pytest.mark.parametrize(("spelled", "names"), [("left", ("left",)), ("[side, left]", ("side", "left")), ("[]", ())])
def test_command_lines_name_one_camera_or_a_list(spelled, names):
    flag = f"--env.reproj.cameras={spelled}"
    more = "--env.more_cameras=[{name: left}]"
    config = draccus.parse(EvalPipelineConfig, args=["--env.type=symview", more, flag, "--eval.n_episodes=1"])
    assert config.env.reproj.cameras == names
    assert make_view("reproj", cameras=spelled if spelled == "left" else list(names)).cameras == names
    assert draccus.encode(config.env.reproj)["cameras"] == list(names)
