"""The whole path of an arm with joints, on the simulated SO-101: record, convert, add views, train, and run."""

import sys

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.robots import make_robot_from_config
from lerobot.scripts import lerobot_edit_dataset, lerobot_rollout
from lerobot.utils.errors import DeviceNotConnectedError

from lerobot_policy_symview.config_so101_sim import So101SimConfig
from lerobot_policy_symview.so101_sim import HELD, NAMES, So101Sim
from lerobot_symview import keys
from lerobot_symview.kinematics import arm_from_plain
from lerobot_symview.runtime.flag_errors import FlagError
from tests.helpers.so101 import convert, record, view
from tests.helpers.training import train

pytestmark = pytest.mark.long


def run_command(monkeypatch, module, *arguments):
    monkeypatch.setattr(sys, "argv", [module.__name__, *arguments])
    module.main()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patched:
        return record(patched, tmp_path_factory.mktemp("so101") / "joints")


@pytest.fixture(scope="module")
def converted(recorded):
    return convert(recorded)


@pytest.fixture(scope="module")
def checkpoint(converted):
    with pytest.MonkeyPatch.context() as patched:
        return train(patched, view(converted), converted.with_suffix(".run"))


def test_lerobot_makes_the_robot_from_its_type():
    robot = make_robot_from_config(So101SimConfig(id="test", seed=3))
    assert isinstance(robot, So101Sim)
    with pytest.raises(DeviceNotConnectedError, match="not connected"):
        robot.get_observation()
    with robot:
        observation = robot.get_observation()
        assert set(observation) == set(robot.observation_features)
        for name, feature in robot.observation_features.items():
            assert isinstance(observation[name], float) if feature is float else observation[name].shape == feature
        depth = observation["side_depth"]
        assert depth.dtype == np.uint16
        assert 500 < np.median(depth) < 1500  # millimetres
        start = np.array([observation[name] for name in NAMES])
        robot.send_action(dict(zip(NAMES, (start + [10, 0, 0, 0, 0, -20]).tolist(), strict=True)))
        moved = np.array([robot.get_observation()[name] for name in NAMES]) - start
        assert 1 < moved[0] < 12
        assert -25 < moved[5] < -2
        assert not robot.is_solved
    assert not robot.is_connected


def test_demonstrations_lift_the_cube_and_are_in_joints(recorded):
    dataset = LeRobotDataset("me/so101", root=recorded)
    assert dataset.num_episodes == 2
    assert dataset.meta.robot_type == "so101_sim"
    for key in (keys.STATE, keys.ACTION):
        assert dataset.meta.features[key]["names"] == list(NAMES)
    assert dataset.meta.features[keys.depth("side")]["info"]["is_depth_map"]
    for episode in dataset.meta.episodes:
        assert HELD < episode["length"] < 40


def test_converted_states_are_those_of_the_tool_and_end_over_the_cube(recorded, converted):
    joints, poses = (LeRobotDataset("test/a", root=root) for root in (recorded, converted))
    arm = arm_from_plain(poses.meta.features[keys.STATE]["info"]["symview"]["arm"])
    frames = range(0, len(joints), 5)
    states = np.stack([joints.hf_dataset[i][keys.STATE].numpy() for i in frames])
    found = np.stack([poses.hf_dataset[i][keys.STATE].numpy() for i in frames])
    np.testing.assert_allclose(found, arm.states(states), atol=1e-6)
    last = poses.hf_dataset[len(poses) - 1][keys.STATE].numpy()
    assert 0.05 < last[2] < 0.15  # metres over the table
    assert 0.2 < last[4] < 0.4  # the aperture, with the cube between the fingers


def test_the_rollout_command_drives_the_robot_by_the_checkpoint_alone(checkpoint, monkeypatch):
    sent = []
    send = So101Sim.send_action

    def send_action(robot, action):
        sent.append((robot.world.joints(), np.array([action[name] for name in NAMES])))
        return send(robot, action)

    monkeypatch.setattr(So101Sim, "send_action", send_action)
    arguments = ["--robot.type=so101_sim", "--robot.seed=5", f"--policy.path={checkpoint}", "--task=Lift the cube."]
    arguments += ["--fps=10", "--duration=1.5", "--return_to_initial_position=false", "--device=cpu"]
    run_command(monkeypatch, lerobot_rollout, *arguments)
    assert len(sent) >= 2
    for joints, targets in sent:
        assert np.isfinite(targets).all()
        assert np.abs(targets - joints)[:5].max() < 10.01  # --policy.max_joint_step


def test_what_the_policy_does_is_recorded_and_is_a_demonstration(checkpoint, recorded, monkeypatch, tmp_path):
    root = tmp_path / "run"
    arguments = ["--robot.type=so101_sim", "--robot.seed=5", f"--policy.path={checkpoint}", "--device=cpu", "--fps=10"]
    arguments += ["--strategy.type=episodic", "--dataset.repo_id=test/rollout_so101", f"--dataset.root={root}"]
    arguments += ["--dataset.single_task=Lift the cube.", "--dataset.num_episodes=1", "--dataset.episode_time_s=2"]
    arguments += ["--dataset.video=false", "--dataset.push_to_hub=false", "--play_sounds=false"]
    run_command(monkeypatch, lerobot_rollout, *arguments)
    demonstrations, run = LeRobotDataset("test/a", root=recorded), LeRobotDataset("test/b", root=root)
    assert run.meta.features == demonstrations.meta.features
    assert len(run) > 2
    views = LeRobotDataset("test/c", root=view(convert(root)))
    assert len(views) == len(run)
    assert keys.view("side", "reproj") in views.meta.features


@pytest.mark.parametrize(
    ("options", "part", "kept"),
    [
        (["--operation.type=delete_episodes", "--operation.episode_indices=[0]"], "", 1),
        (["--operation.type=split", '--operation.splits={"train": [0], "val": [1]}'], "train", 0),
    ],
)
def test_lerobots_editor_works_on_the_converted_dataset(converted, options, part, kept, tmp_path, monkeypatch):
    arguments = ["--repo_id=test/so101_ee", f"--root={converted}", f"--new_root={tmp_path / 'edited'}"]
    run_command(monkeypatch, lerobot_edit_dataset, *arguments, "--new_repo_id=test/edited", *options)
    source = LeRobotDataset("test/so101_ee", root=converted)
    edited = LeRobotDataset("test/edited", root=tmp_path / "edited" / part)
    assert edited.num_episodes == 1
    assert edited.meta.features == source.meta.features  # the arm among them
    start, end = (source.meta.episodes[kept][f"dataset_{end}_index"] for end in ("from", "to"))
    assert len(edited) == end - start
    for key in (keys.STATE, keys.ACTION, keys.rgb("side"), keys.depth("side"), keys.world_from_cam("side")):
        assert edited[3][key].equal(source[start + 3][key]), key


def test_a_negative_scene_is_refused():
    with pytest.raises(FlagError, match=r"--robot\.seed must not be negative, got -1"):
        So101SimConfig(seed=-1)
