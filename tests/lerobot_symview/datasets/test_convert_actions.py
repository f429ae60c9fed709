"""Joints become an end effector's states and actions: to the simulator's numbers, whole, resumable, and checked."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset, aggregate_datasets
from scipy.spatial.transform import Rotation

from lerobot_policy_symview.symmetry.representations import types_of
from lerobot_symview import keys
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.datasets import derivation
from lerobot_symview.datasets.add_views import AddViewsConfig, add_views
from lerobot_symview.datasets.convert_actions import ConvertActionsConfig, convert_actions, main
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.datasets.metadata import read_info
from lerobot_symview.datasets.robot_flags import RobotFlags
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.kinematics import arm_from_plain
from lerobot_symview.runtime.cli import CommandError
from tests.helpers.arms import (
    CAMERAS,
    JOINTS,
    NAMES,
    SO101,
    SO101_MJCF,
    arm_recording,
    mujoco_places,
    record_arm,
    so101,
    yaws,
)
from tests.helpers.datasets import contents, interrupted_at_the_second_part

FRAMES, EPISODES = 40, 2


@pytest.fixture(scope="session")
def recorded_arm(tmp_path_factory):
    return record_arm(tmp_path_factory.mktemp("arm") / "arm", EPISODES, FRAMES)


@pytest.fixture(scope="session")
def cameras_file(tmp_path_factory):
    file = tmp_path_factory.mktemp("calibration") / "cameras.yaml"
    file.write_text(CAMERAS)
    return file


def config_of(source, target, cameras=None, robot=None, **options):
    return ConvertActionsConfig(
        HubDataset("test/arm", source),
        robot or RobotFlags(preset="so101"),
        new_repo_id="test/ee",
        new_root=target,
        calibration=cameras,
        **options,
    )


@pytest.fixture(scope="session")
def converted(recorded_arm, cameras_file, tmp_path_factory):
    return convert_actions(config_of(recorded_arm, tmp_path_factory.mktemp("ee") / "ee", cameras_file, keep=True))


def columns_of(folder, *names):
    dataset = LeRobotDataset("test/any", root=folder)
    return [np.array(dataset.hf_dataset.with_format("numpy")[name]) for name in names]


def joints():
    states, actions = zip(*(arm_recording(FRAMES, float(episode)) for episode in range(EPISODES)), strict=True)
    return np.concatenate(states), np.concatenate(actions)


def test_states_are_where_the_simulator_has_the_gripper_in_the_axes_of_the_base(converted):
    """The base stands 0.25 m from the workspace's centre, turned by 90 degrees, 2 cm above the table."""
    state, aperture = columns_of(converted, keys.STATE)[0], np.clip(joints()[0][:, 5] / 100, 0, 1)
    places, matrices = mujoco_places(np.deg2rad(joints()[0][:, :5]))
    np.testing.assert_allclose(state[:, :3], places - [0.25, 0, -0.02], atol=1e-4)
    yaw = yaws(matrices[:, :, 0], matrices[:, :, 2])
    assert np.rad2deg(np.abs(np.sin(state[:, 3] - yaw))).max() < 0.1
    np.testing.assert_allclose(state[:, 4], aperture, atol=1e-6)
    outwards = places[:, :2] - so101().pivot
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    tilt = np.arctan2((matrices[:, :2, 0] * outwards).sum(axis=1), -matrices[:, 2, 0])
    np.testing.assert_allclose(state[:, 5], tilt, atol=2e-4)


def test_an_increment_leads_to_the_targets_of_the_joints(converted):
    state, action = columns_of(converted, keys.STATE, keys.ACTION)
    places, _ = mujoco_places(np.deg2rad(joints()[1][:, :5]))
    np.testing.assert_allclose((state + action)[:, :3], places - [0.25, 0, -0.02], atol=1e-4)
    np.testing.assert_allclose(action[:, 4], np.clip(joints()[1][:, 5] / 100, 0, 1), atol=1e-6)


def test_an_increment_may_reach_further_ahead_but_not_beyond_the_episode(
    recorded_arm, cameras_file, tmp_path, converted
):
    near, state = columns_of(converted, keys.ACTION, keys.STATE)
    folder = convert_actions(config_of(recorded_arm, tmp_path / "ee", cameras_file, horizon=5))
    far = columns_of(folder, keys.ACTION)[0]
    for index in range(FRAMES):
        later = min(index + 4, FRAMES - 1)
        np.testing.assert_allclose((state + far)[index, :3], (state + near)[later, :3], atol=1e-6)


def test_targets_are_those_of_lerobots_end_effector(recorded_arm, cameras_file, tmp_path):
    folder = convert_actions(config_of(recorded_arm, tmp_path / "ee", cameras_file, actions="target"))
    info = read_info(folder)["features"][keys.ACTION]
    assert info["names"] == ["ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz", "ee.gripper_pos"]
    action = columns_of(folder, keys.ACTION)[0]
    places, matrices = mujoco_places(np.deg2rad(joints()[1][:, :5]), offset=0.0)  # of the model's own frame
    np.testing.assert_allclose(action[:, :3], places, atol=1e-4)
    frames = Rotation.from_rotvec(action[:, 3:6]).as_matrix()
    np.testing.assert_allclose(frames[:, :, 2], matrices[:, :, 0], atol=1e-4)  # the URDF's frame points along z
    np.testing.assert_allclose(frames[:, :, 1], matrices[:, :, 1], atol=1e-4)
    np.testing.assert_allclose(action[:, 6], np.clip(joints()[1][:, 5], 0, 100), atol=1e-4)


def test_the_symmetry_is_declared_by_the_names_and_the_arm_by_the_feature(converted):
    features = read_info(converted)["features"]
    assert types_of(features[keys.STATE]["names"]) == ["x", "y", "z", "yaw", "aperture", "scalar"]
    assert types_of(features[keys.ACTION]["names"]) == ["x", "y", "z", "yaw", "aperture", "scalar"]
    arm = arm_from_plain(features[keys.STATE]["info"]["symview"]["arm"])
    np.testing.assert_allclose(columns_of(converted, keys.STATE)[0], arm.states(joints()[0]), atol=1e-6)


def test_calibration_and_workspace_are_added_in_the_axes_of_the_base(converted, cameras_file):
    calibration = read_calibration(cameras_file)
    features = read_info(converted)["features"]
    for key in (keys.STATE, keys.rgb("front")):
        assert features[key]["info"]["symview"]["workspace"]["center"] == pytest.approx([0.25, 0.0])
    pose = columns_of(converted, keys.world_from_cam("front"))[0]
    np.testing.assert_array_equal(pose[0].reshape(4, 4), calibration.cameras["front"].world_from_cam.astype(np.float32))
    assert (pose == pose[0]).all()


def test_views_are_added_without_further_flags(converted, tmp_path):
    config = AddViewsConfig(
        HubDataset("test/ee", converted), new_repo_id="test/v", new_root=tmp_path / "v", views=["persp"], camera="front"
    )
    assert keys.view("front", "persp") in read_info(add_views(config))["features"]


def test_kept_joints_and_all_other_columns_are_the_sources(recorded_arm, converted):
    kept = columns_of(converted, keys.JOINTS, keys.JOINT_TARGETS)
    for before, after in zip(joints(), kept, strict=True):
        np.testing.assert_array_equal(before, after)
    source, result = (LeRobotDataset("test/any", root=folder) for folder in (recorded_arm, converted))
    for index in (0, FRAMES, FRAMES * EPISODES - 1):
        assert (source[index][keys.rgb("front")] == result[index][keys.rgb("front")]).all()
        assert source[index]["timestamp"] == result[index]["timestamp"]


def test_statistics_are_complete_over_the_dataset_and_every_episode(converted):
    stats = json.loads((converted / "meta" / "stats.json").read_text())
    (rows,) = (pq.read_table(file) for file in (converted / "meta" / "episodes").rglob("*.parquet"))
    for key in (keys.STATE, keys.ACTION, keys.JOINTS, keys.JOINT_TARGETS):
        (values,) = columns_of(converted, key)
        for name in ("min", "max", "mean", "std"):
            np.testing.assert_allclose(stats[key][name], getattr(values, name)(axis=0), rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(stats[key]["q99"], np.quantile(values, 0.99, axis=0), rtol=1e-4, atol=1e-6)
        assert stats[key]["count"] == [FRAMES * EPISODES]
        for episode in range(EPISODES):
            own = values[episode * FRAMES : (episode + 1) * FRAMES]
            np.testing.assert_allclose(
                rows[f"stats/{key}/mean"][episode].as_py(), own.mean(axis=0), rtol=1e-4, atol=1e-7
            )
    assert set(read_info(converted)["features"]) == set(stats)


def test_lerobot_merges_converted_datasets(converted, tmp_path):
    aggregate_datasets(["a/a", "a/b"], "a/c", [converted, converted], tmp_path / "merged")
    merged = read_info(tmp_path / "merged")["features"][keys.STATE]
    assert merged["info"]["symview"] == read_info(converted)["features"][keys.STATE]["info"]["symview"]


@pytest.mark.long
def test_videos_are_copied(cameras_file, tmp_path):
    source = record_arm(tmp_path / "arm", use_videos=True)
    result = convert_actions(config_of(source, tmp_path / "ee", cameras_file))
    copied = {path: data for path, data in contents(result).items() if path.suffix == ".mp4"}
    assert copied
    assert copied == {path: data for path, data in contents(source).items() if path.suffix == ".mp4"}


def test_an_interrupted_run_is_resumed_and_workers_change_nothing(recorded_arm, cameras_file, tmp_path, monkeypatch):
    monkeypatch.setattr(derivation, "PART_FRAMES", 1)
    reference = contents(convert_actions(config_of(recorded_arm, tmp_path / "reference", cameras_file)))
    target = tmp_path / "derived"
    with interrupted_at_the_second_part(monkeypatch):
        convert_actions(config_of(recorded_arm, target, cameras_file))
    assert not target.exists()
    with pytest.raises(CommandError, match="is from an interrupted run: add --resume=true"):
        convert_actions(config_of(recorded_arm, target, cameras_file))
    with pytest.raises(CommandError, match="is from a run with different horizon"):
        convert_actions(config_of(recorded_arm, target, cameras_file, horizon=2, resume=True))
    convert_actions(config_of(recorded_arm, target, cameras_file, resume=True))
    assert contents(target) == reference
    convert_actions(config_of(recorded_arm, target, cameras_file, resume=True))  # already complete
    assert contents(target) == reference
    with pytest.raises(CommandError, match="exists already"):
        convert_actions(config_of(recorded_arm, target, cameras_file))


@pytest.mark.parametrize(
    ("robot", "names", "convert"),
    [
        ({"units": "radians"}, NAMES, lambda values: np.concatenate([np.deg2rad(values[:5]), values[5:]])),
        ({}, tuple(NAMES[i] for i in (5, 3, 0, 1, 4, 2)), None),
        (
            {"signs": {"elbow_flex": -1}, "offsets": {"wrist_roll": 90}},
            NAMES,
            lambda values: values * [1, 1, -1, 1, 1, 1] - [0, 0, 0, 0, 90, 0],
        ),
        ({"gripper_range": (1, 0)}, NAMES, lambda v: np.append(v[:5], 1 - v[5] / 100)),
        ({"preset": None, "urdf": SO101, "tool_frame": "gripper_frame_link", "tool_offset": 0.04}, NAMES, None),
        (
            {"preset": None, "mjcf": SO101_MJCF, "tool_frame": "gripperframe", "approach": "x", "tool_offset": 0.04},
            NAMES,
            None,
        ),
        (
            {"joints": dict(zip("abcdef", [*JOINTS, "gripper"], strict=True)), "gripper": "f"},
            ("a", "b", "c", "d", "e", "f"),
            None,
        ),
    ],
)
def test_units_orders_and_names_give_the_same_states(tmp_path, cameras_file, converted, robot, names, convert):
    source = record_arm(tmp_path / "arm", EPISODES, FRAMES, names, convert)
    folder = convert_actions(
        config_of(source, tmp_path / "ee", cameras_file, RobotFlags(**({"preset": "so101"} | robot)))
    )
    for expected, found in zip(*(columns_of(one, keys.STATE, keys.ACTION) for one in (converted, folder)), strict=True):
        np.testing.assert_allclose(found, expected, atol=5e-5)


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        ({"units": "radians"}, "--robot.units.*shoulder_pan goes from .* limits are .*degrees taken for radians"),
        ({"units": "normalized"}, "--robot: normalized joints need LeRobot's calibration file"),
        ({"offsets": {"elbow_flex": 120}}, "elbow_flex goes from .*a sign or an offset wrong"),
        ({"signs": {"elbow_flex": 2}}, "--robot: signs must be 1 or -1"),
        ({"joints": {"elbow": "elbow_flex"}}, "unknown joint of the dataset 'elbow'.*mean 'elbow_flex'"),
        ({"joints": {"elbow_flex": "elbow"}}, "unknown joint of the model 'elbow'"),
        ({"joints": {"elbow_flex": "wrist_flex"}}, "elbow_flex and wrist_flex are both 'wrist_flex' of the model"),
        ({"gripper": "jaw"}, "--robot: .*'?jaw"),
        ({"preset": "panda"}, "lacks panda_joint1, .*its other dimensions are shoulder_pan.*match the names by joints"),
        ({"preset": None}, "--robot: the arm's model is missing"),
        ({"preset": None, "urdf": SO101}, "--robot: tool_frame is missing"),
        ({"preset": None, "urdf": Path("none.urdf"), "tool_frame": "a"}, "--robot: cannot read none.urdf"),
    ],
)
def test_a_wrong_arm_is_refused_and_nothing_written(recorded_arm, cameras_file, tmp_path, robot, message):
    flags = RobotFlags(**({"preset": "so101"} | robot))
    with pytest.raises(ValueError, match=message):
        convert_actions(config_of(recorded_arm, tmp_path / "ee", cameras_file, flags))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--robot.preset=so100"],
            "--robot.preset must be one of so101, panda, whose models packages ship, got 'so100'",
        ),
        (["--robot.preset=so101", "--robot.urdf=a"], "--robot.preset and --robot.urdf exclude each other"),
        (["--robot.approach=up"], "unknown --robot.approach 'up', expected one of: x, y, z"),
        (["--robot.opening=up"], "unknown --robot.opening 'up'"),
        (["--robot.gripper_range=[1, 1]"], "--robot.gripper_range must be two different numbers, got 1.0 and 1.0"),
        (["--robot.tool_offset=30"], "--robot.tool_offset must be metres, below 0.3, got 30"),
        (["--robot.units=turns"], "turns"),
        (["--horizon=0"], "--horizon must be at least 1, got 0"),
        (["--horizon=3", "--actions=target"], "--horizon=3 is of increments"),
        (["--actions=velocity"], "velocity"),
        (["--num_workers=0"], "--num_workers must be at least 1, got 0"),
        (["--new_repo_id=me", "--workspace.size=0.3"], "--new_repo_id must look like user/name"),
        ([], "give --calibration=cameras.yaml, with the workspace and the base"),
        (["--workspace.size=0.3"], "--dataset: there is no LeRobot dataset"),
    ],
)
def test_wrong_flags_are_one_line(monkeypatch, capsys, tmp_path, arguments, message):
    monkeypatch.setattr(
        sys, "argv", ["symview-convert-actions", "--dataset.repo_id=a/b", f"--root={tmp_path / 'none'}", *arguments]
    )
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code in (1, 2)
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_radians_taken_for_degrees_are_refused(tmp_path, cameras_file):
    source = record_arm(tmp_path / "arm", convert=np.deg2rad)
    with pytest.raises(ValueError, match=r"no joint exceeds .* look like radians"):
        convert_actions(config_of(source, tmp_path / "ee", cameras_file))


def test_a_workspace_in_the_frame_of_the_base_needs_no_file(recorded_arm, tmp_path, converted):
    folder = convert_actions(config_of(recorded_arm, tmp_path / "ee", workspace=Workspace((0.25, 0.0), 0.3)))
    lower = columns_of(folder, keys.STATE)[0] + [0, 0, 0.02, 0, 0, 0]  # the base is at the table's height
    np.testing.assert_allclose(lower, columns_of(converted, keys.STATE)[0], atol=1e-6)


def test_a_camera_of_another_size_is_refused(recorded_arm, cameras_file, tmp_path):
    other = tmp_path / "other.yaml"
    other.write_text(CAMERAS.replace("height: 60", "height: 48"))
    with pytest.raises(ValueError, match=r"--calibration: camera 'front' has 48 x 80 pixels.*\(60, 80\)"):
        convert_actions(config_of(recorded_arm, tmp_path / "ee", other))


def test_a_gripper_below_the_table_is_reported(recorded_arm, tmp_path, caplog):
    file = tmp_path / "high.yaml"
    file.write_text(CAMERAS.replace("-0.05, 0.02", "-0.05, -0.3"))
    convert_actions(config_of(recorded_arm, tmp_path / "ee", file))
    assert "the gripper is more than 30 mm below the table" in caplog.text


def test_dimensions_without_names_are_refused(recorded_arm, cameras_file, tmp_path):
    source = tmp_path / "arm"
    shutil.copytree(recorded_arm, source)
    info = json.loads((source / "meta" / "info.json").read_text())
    info["features"][keys.ACTION]["names"] = None
    (source / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(ValueError, match="the action's dimensions have no names, by which joints are matched"):
        convert_actions(config_of(source, tmp_path / "ee", cameras_file))
