"""Fine-tuning and evaluation of a checkpoint on a camera of another name, by LeRobot's commands in this process."""

import json
import sys

import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors
from lerobot.scripts import lerobot_eval, lerobot_train

from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_symview import keys
from lerobot_symview.datasets.add_views import add_views
from lerobot_symview.geometry.placement import CameraSpec
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset
from tests.helpers.datasets import views_config
from tests.helpers.training import train

pytestmark = pytest.mark.long

RENAME = '--rename_map={"observation.images.front": "observation.images.side"}'
CAMERA = "--policy.camera=front"


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    """Folder of a dataset with the camera `front`, which sees the table from elsewhere, and the oracle's camera."""
    folder = tmp_path_factory.mktemp("front") / "raw"
    env = RecordedEnv(camera=CameraSpec(name="front", elevation_deg=55.0))
    return generate(GenerateConfig(NewDataset("test/front", folder), num_episodes=1, env=env))


@pytest.fixture(scope="module")
def views(raw):
    """Folder of the same dataset with the view in place of the cameras' images."""
    return add_views(views_config(raw, raw.with_name("views"), views=["reproj"], camera="front", keep=[]))


@pytest.fixture(scope="module")
def checkpoint(with_views, tmp_path_factory):
    """Folder of a policy trained on the camera `side`."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        return train(monkeypatch, with_views, tmp_path_factory.mktemp("checkpoint") / "policy")


def fine_tune(monkeypatch, checkpoint, dataset, output, *options):
    return train(monkeypatch, dataset, output, *options, policy=[f"--policy.path={checkpoint}"])


def frame(folder):
    """The first frame of a dataset, as LeRobot's loader delivers it, with depth in metres."""
    dataset = LeRobotDataset("test/front", root=folder, depth_output_unit="m")
    return {key: value for key, value in dataset[0].items() if key.startswith("observation.")}


def check(tuned, camera, raw, views):
    """Check that the policy is one of `camera`, and makes the recorded view of a raw frame of the camera `front`."""
    config = PreTrainedConfig.from_pretrained(tuned)
    assert config.camera == camera
    assert {keys.rgb(camera), keys.depth(camera)} <= set(config.input_features)
    policy = SymviewBcPolicy.from_pretrained(tuned)
    preprocess, _ = make_pre_post_processors(policy.config, str(tuned))
    made, recorded = preprocess(frame(raw)), frame(views)
    for output in ("reproj", "reproj_height"):
        torch.testing.assert_close(made[keys.view(camera, output)][0], recorded[keys.view("front", output)])
    assert torch.isfinite(policy.select_action(preprocess(recorded | {keys.STATE: frame(raw)[keys.STATE]}))).all()


@pytest.mark.parametrize("dataset", ["raw", "views"])
@pytest.mark.parametrize(
    ("flags", "camera", "line"),
    [
        ([CAMERA], "front", "is made anew for the camera 'front' (changed: camera, calibration)"),
        ([RENAME], "side", "no images of the camera 'side': those of 'front' take their place, if --rename_map"),
        ([CAMERA, RENAME], "front", "is made anew for the camera 'front'"),
    ],
    ids=["camera", "rename", "both"],
)
def test_fine_tuning(checkpoint, raw, views, dataset, flags, camera, line, tmp_path, monkeypatch, capsys):
    folder = raw if dataset == "raw" else views
    tuned = fine_tune(monkeypatch, checkpoint, folder, tmp_path / "tuned", *flags)
    assert line in capsys.readouterr().err
    check(tuned, camera, raw, views)
    calibration = PreTrainedConfig.from_pretrained(tuned).calibration
    pose = frame(raw)[keys.world_from_cam("front")].reshape(4, 4)  # not the former camera's
    torch.testing.assert_close(torch.tensor(calibration["cameras"][camera]["world_from_cam"]), pose)
    if flags == [RENAME]:
        resumed = [f"--config_path={tuned}/train_config.json", "--resume=true", "--steps=3"]
        monkeypatch.setattr(sys, "argv", ["lerobot-train", *resumed])
        lerobot_train.main()
        check(tuned.resolve().parents[1] / "000003" / "pretrained_model", camera, raw, views)


def test_errors_name_the_flags(checkpoint, views, tmp_path, monkeypatch, capsys):
    with pytest.raises(ValueError, match="--rename_map"):
        fine_tune(monkeypatch, checkpoint, views, tmp_path / "tuned")
    assert "--policy.camera=front trains under the dataset's name" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"the dataset has no images of the camera 'side': use --policy.camera=front"):
        train(monkeypatch, views, tmp_path / "new")
    with pytest.raises(ValueError, match=r"give its name by --policy.camera"):
        train(monkeypatch, views, tmp_path / "new", "--policy.method=sideview_equi")


def test_fine_tuning_on_images_of_a_camera(recorded, raw, tmp_path, monkeypatch):
    """A policy without a view reads the camera's own images, here lifted to points by its calibration."""
    method = "--policy.method=point_cloud_equi"
    pretrained = train(monkeypatch, recorded, tmp_path / "policy", method)
    for flag, camera in ((CAMERA, "front"), (RENAME, "side")):
        tuned = fine_tune(monkeypatch, pretrained, raw, tmp_path / camera, flag)
        assert PreTrainedConfig.from_pretrained(tuned).all_raw_keys == [keys.rgb(camera), keys.depth(camera)]


@pytest.mark.parametrize("flags", [[CAMERA], [RENAME], [CAMERA, RENAME]], ids=["camera", "rename", "both"])
def test_evaluation(checkpoint, flags, tmp_path, monkeypatch):
    command = ["lerobot-eval", f"--policy.path={checkpoint}", "--policy.device=cpu", "--env.type=symview", *flags]
    command += ["--env.camera.name=front", "--env.max_steps=2", "--env.oracle=true", "--eval.n_episodes=1"]
    monkeypatch.setattr(sys, "argv", [*command, "--eval.batch_size=1", f"--output_dir={tmp_path / 'eval'}"])
    lerobot_eval.main()
    assert (tmp_path / "eval" / "eval_info.json").is_file()


def test_the_calibration_can_be_replaced(checkpoint, raw, tmp_path):
    """A file's calibration of a robot's camera takes the place of the one that the policy was trained with."""
    matrix = frame(raw)[keys.world_from_cam("front")].reshape(4, 4).tolist()
    saved = PreTrainedConfig.from_pretrained(checkpoint).calibration["cameras"]["side"]
    calibration = {"units": "m", "cameras": {"front": saved | {"world_from_cam": matrix}}}
    (tmp_path / "cameras.yaml").write_text(json.dumps(calibration))
    flags = ["--camera=front", f"--calibration=include {tmp_path}/cameras.yaml"]
    config = PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=flags)
    config.pretrained_path = checkpoint
    policy = SymviewBcPolicy.from_pretrained(checkpoint, config=config)
    assert policy.config.pretrained_path is None  # as LeRobot asks before it loads the processors
    preprocess, _ = make_pre_post_processors(policy.config)
    images = {key: value for key, value in frame(raw).items() if not key.startswith("observation.camera.")}
    made, expected = preprocess(images), preprocess(frame(raw))
    assert torch.equal(made[keys.view("front", "reproj")], expected[keys.view("front", "reproj")])
