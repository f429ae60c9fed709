"""A robot with LeRobot's end-effector names, whose base stands beside the workspace, turned by 90 degrees."""

import json

import numpy as np
import pytest
import torch
import yaml
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors
from scipy.spatial.transform import Rotation

from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_symview import keys
from lerobot_symview.datasets.add_views import AddViewsConfig, add_views
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.state_reader import END_EFFECTOR
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import ReprojectedView
from tests.helpers.datasets import images_of
from tests.helpers.training import train

pytestmark = pytest.mark.long

BASE, YAW = np.array([0.45, -0.35, 0.03]), 90.0
OPTIONS = ReprojectedView(size=76, infill="none")


def in_base(state):
    """The state in LeRobot's names, in the frame of the base."""
    x, y, z, yaw, aperture = state
    position = np.array([x + Workspace().center[0], y + Workspace().center[1], z]) - BASE
    turned = Rotation.from_euler("z", -YAW, degrees=True)
    rotation = turned * Rotation.from_euler("z", yaw) * Rotation.from_euler("x", np.pi)
    return np.array([*turned.apply(position), *rotation.as_rotvec(), 100 * aperture], dtype=np.float32)


@pytest.fixture(scope="module")
def robot(recorded, tmp_path_factory):
    """The recorded demonstrations as a robot delivers them, without calibration, and its calibration file."""
    folder = tmp_path_factory.mktemp("robot")
    source = LeRobotDataset("test/recorded", root=recorded, depth_output_unit="m")
    names = [keys.rgb("side"), keys.depth("side"), keys.ACTION]
    features = {name: dict(source.meta.features[name]) for name in names}
    features |= {keys.STATE: {"dtype": "float32", "shape": (7,), "names": list(END_EFFECTOR)}}
    for feature in features.values():
        feature.get("info", {}).pop("symview", None)
    dataset = LeRobotDataset.create("test/robot", 4, features, root=folder / "data", use_videos=False)
    length = source.meta.episodes[0]["length"]
    for index in range(length):
        item = source[index]
        frame = {keys.ACTION: item[keys.ACTION].numpy(), keys.STATE: in_base(item[keys.STATE].numpy())}
        frame[keys.rgb("side")] = (item[keys.rgb("side")].permute(1, 2, 0) * 255).round().byte().numpy()
        frame[keys.depth("side")] = item[keys.depth("side")].permute(1, 2, 0).numpy()
        dataset.add_frame(frame | {"task": "pick"})
    dataset.save_episode()
    dataset.finalize()
    item = source[0]
    matrices = {name: item[getattr(keys, name)("side")].numpy().tolist() for name in ("intrinsics", "world_from_cam")}
    height, width = source.meta.features[keys.rgb("side")]["shape"][:2]
    content = {
        "units": "m",
        "workspace": {"center": list(Workspace().center), "size": Workspace().size},
        "robot_base": {"position": BASE.tolist(), "yaw_deg": YAW},
        "cameras": {"side": {"height": height, "width": width, **matrices}},
    }
    file = folder / "cameras.yaml"
    file.write_text(yaml.safe_dump(content))
    return folder / "data", file, source, length


def views_of(source, target, **options):
    add_views(
        AddViewsConfig(HubDataset("test/views", source), new_root=target, views=["reproj"], reproj=OPTIONS, **options)
    )
    return images_of(target, "observation.images.side_reproj")


def test_views_are_those_of_our_own_states_in_the_axes_of_the_base(robot, recorded, tmp_path):
    """Clipped at the same height, over the same square; turned, as the base's axes are."""
    folder, file, _, length = robot
    ours = views_of(recorded, tmp_path / "ours")[:length]
    theirs = views_of(folder, tmp_path / "theirs", calibration=file)
    expected = np.rot90(ours, -1, axes=(-2, -1))
    assert (np.abs(theirs - expected).max(axis=1) > 0.01).mean() < 0.01  # points on the edge of two cells
    stored = json.loads((tmp_path / "theirs" / "meta" / "symview_views.json").read_text())
    assert stored["calibration"]["origin_height"] == pytest.approx(0.03)


def test_a_view_that_is_added_later_is_clipped_at_the_same_height(robot, tmp_path):
    """The calibration is in the dataset by then; the height of the base is in the file of the earlier views."""
    folder, file, _, _ = robot
    expected = views_of(folder, tmp_path / "at_once", calibration=file)
    source = HubDataset("test/views", folder)
    add_views(AddViewsConfig(source, new_root=tmp_path / "first", views=["persp"], calibration=file))
    np.testing.assert_array_equal(views_of(tmp_path / "first", tmp_path / "second"), expected)
    stored = json.loads((tmp_path / "second" / "meta" / "symview_views.json").read_text())
    assert stored["calibration"]["origin_height"] == pytest.approx(0.03)


def test_a_policy_reads_the_state_in_training_and_on_the_robot(robot, tmp_path, monkeypatch):
    folder, file, source, length = robot
    views_of(folder, tmp_path / "views", calibration=file)
    checkpoint = train(monkeypatch, tmp_path / "views", tmp_path / "policy")
    policy = SymviewBcPolicy.from_pretrained(checkpoint)
    preprocessor, _ = make_pre_post_processors(policy.config, pretrained_path=str(checkpoint))
    assert policy.config.state_names == list(END_EFFECTOR)
    assert policy.config.origin_height == pytest.approx(0.03)
    for index in (0, length - 1):
        item = source[index]
        observed = {key: item[key] for key in (keys.rgb("side"), keys.depth("side"))}
        observed[keys.STATE] = torch.from_numpy(in_base(item[keys.STATE].numpy()))
        x, y, z, yaw, aperture = item[keys.STATE].numpy()
        expected = [y, -x, z, yaw - np.pi / 2, aperture]  # in the axes of the base, from the workspace's centre
        read = preprocessor(observed)
        np.testing.assert_allclose(read[keys.STATE][0], expected, atol=1e-5)
        assert policy.select_action(read).isfinite().all()
    with pytest.raises(ValueError, match="has 5 dimensions, the policy was trained with 7: ee"):
        preprocessor(observed | {keys.STATE: item[keys.STATE]})


def test_views_of_absolute_positions_tell_the_policy_what_they_count_from(recorded, tmp_path, monkeypatch):
    views_of(recorded, tmp_path / "views", state_origin="world")
    checkpoint = train(monkeypatch, tmp_path / "views", tmp_path / "policy")
    config = json.loads((checkpoint / "config.json").read_text())
    assert config["state_origin"] == "world"
    assert config["state_names"] == keys.STATE_NAMES
    with pytest.raises(ValueError, match=r"state_origin=base: the dataset's views were made with --state_origin=world"):
        train(monkeypatch, tmp_path / "views", tmp_path / "other", "--policy.state_origin=base")


def test_robot_base_contradicts_positions_that_count_from_elsewhere(robot, recorded, tmp_path):
    for options in ({"state_origin": "world"}, {}):
        with pytest.raises(
            CalibrationError, match="robot_base moves the cameras to the axes of the base, but the stat"
        ):
            views_of(recorded, tmp_path / "views", calibration=robot[1], **options)
    assert list(tmp_path.iterdir()) == []


def test_a_checkpoint_takes_another_origin_from_a_flag(robot, recorded, tmp_path, monkeypatch):
    """Fine-tuned on data whose positions count from the world, a policy makes its preprocessing anew."""
    first = train(monkeypatch, recorded, tmp_path / "first")
    again = train(
        monkeypatch, recorded, tmp_path / "again", "--policy.state_origin=world", policy=(f"--policy.path={first}",)
    )
    saved = json.loads((again / "policy_preprocessor.json").read_text())["steps"]
    (state,) = [step["config"] for step in saved if step["registry_name"] == "symview_state"]
    assert state == {"names": keys.STATE_NAMES, "origin": [0.45, 0.0, 0.0]}


def test_a_table_height_is_kept_by_views_and_policy(recorded, robot, tmp_path, monkeypatch):
    """Positions that count from the world, 0.8 m below the table; nothing of it changes a view."""
    content = yaml.safe_load(robot[1].read_text())
    del content["robot_base"]
    for camera in content["cameras"].values():
        camera["world_from_cam"][11] += 0.8
    content["workspace"]["table_height"] = 0.8
    file = tmp_path / "cameras.yaml"
    file.write_text(yaml.safe_dump(content))
    options = {"calibration": file, "state_origin": "world"}
    add_views(AddViewsConfig(HubDataset("t/v", robot[0]), new_root=tmp_path / "v", views=["persp"], **options))
    checkpoint = train(monkeypatch, tmp_path / "v", tmp_path / "policy", "--policy.method=persp_equi")
    config = json.loads((checkpoint / "config.json").read_text())
    assert (config["state_origin"], config["origin_height"]) == ("world", pytest.approx(-0.8))


def test_absolute_positions_under_our_names_are_centred(robot, recorded, tmp_path, monkeypatch):
    """The same dataset, declared to count from the world: the workspace's centre is subtracted."""
    checkpoint = train(monkeypatch, recorded, tmp_path / "policy", "--policy.state_origin=world")
    policy = SymviewBcPolicy.from_pretrained(checkpoint)
    preprocessor, _ = make_pre_post_processors(policy.config, pretrained_path=str(checkpoint))
    item = robot[2][0]
    read = preprocessor({key: value for key, value in item.items() if key.startswith("observation.")})
    np.testing.assert_allclose(read[keys.STATE][0], item[keys.STATE] - torch.tensor([0.45, 0.0, 0.0, 0.0, 0.0]))
