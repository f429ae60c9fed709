"""A robot's numbers: matched by name, in their units, there and back, and refused where they contradict the model."""

import json

import numpy as np
import pytest

from lerobot_symview.errors import KinematicsError
from lerobot_symview.kinematics import arm_from_plain, check_positions, joint_scales, solve
from lerobot_symview.kinematics.arm import APERTURE, pose_after
from tests.helpers.arms import CENTER, JOINTS, NAMES, mujoco_places, so101, so101_arm, yaws

MOTORS = {
    name: {"id": index, "drive_mode": 0, "homing_offset": 7, "range_min": 800, "range_max": 3300 - 100 * index}
    for index, name in enumerate([*JOINTS, "gripper"])
}


def recording(count=60):
    """States and, some frames ahead of them, actions: a smooth motion over the table, degrees."""
    time = np.linspace(0, 2, count + 3)[:, None]
    middle, swing = np.array([0, -20, 40, 60, 10]), np.array([40, 10, 15, 10, 30])
    angles = middle + swing * np.sin(time * [1.0, 1.7, 1.3, 0.9, 1.1])
    values = np.concatenate([angles, 50 + 50 * np.sin(time)], axis=1)
    return values[:-3], values[3:]


def test_the_state_is_where_mujoco_has_the_gripper():
    states, _ = recording()
    places, matrices = mujoco_places(np.deg2rad(states[:, :5]))
    found = so101_arm().states(states)
    np.testing.assert_allclose(found[:, :3] + [*CENTER, 0], places, atol=1e-4)
    difference = found[:, 3] - yaws(matrices[:, :, 0], matrices[:, :, 2])
    np.testing.assert_allclose(np.sin(difference), 0, atol=1e-3)
    np.testing.assert_allclose(found[:, APERTURE], np.clip(states[:, 5] / 100, 0, 1))


def test_joints_are_matched_by_name():
    states, actions = recording()
    order = [5, 2, 0, 1, 4, 3]
    shuffled = so101_arm(state_names=tuple(NAMES[i] for i in order))
    np.testing.assert_array_equal(shuffled.states(states[:, order]), so101_arm().states(states))
    np.testing.assert_array_equal(
        shuffled.increments(states[:, order], actions), so101_arm().increments(states, actions)
    )


def test_there_and_back_on_a_recorded_trajectory():
    arm = so101_arm()
    states, actions = recording()
    increments = arm.increments(states, actions)
    for state, action, increment in zip(states, actions, increments, strict=True):
        target = pose_after(arm.poses(state[None])[0], increment)
        found = solve(arm.model, arm.positions(state[None])[0], target)
        back = arm.actions(found.positions[None], increment[[APERTURE]])[0]
        np.testing.assert_allclose(back[:5], action[:5], atol=0.1)  # degrees
        assert back[5] == pytest.approx(np.clip(action[5], 0, 100), abs=1e-3)


def test_units_signs_and_offsets(tmp_path):
    radians, _ = joint_scales(so101(), JOINTS, "radians")
    degrees, offset = joint_scales(so101(), JOINTS, "degrees", signs={"elbow_flex": -1}, offsets={"wrist_roll": 90})
    assert radians.tolist() == [1] * 5
    np.testing.assert_allclose(degrees, np.deg2rad([1, 1, -1, 1, 1]))
    np.testing.assert_allclose(offset, np.deg2rad([0, 0, 0, 0, 90]))
    file = tmp_path / "follower.json"
    file.write_text(json.dumps(MOTORS))
    scale, _ = joint_scales(so101(), JOINTS, "normalized", file)
    # 100 is range_max, in degrees from the middle of the range, as LeRobot's motors count them
    np.testing.assert_allclose(np.rad2deg(scale * 100), [(2500 - 100 * i) / 2 * 360 / 4095 for i in range(5)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"units": "turns"}, "units must be one of degrees, radians, normalized, got 'turns'"),
        ({"signs": {"elbow": -1}}, "signs names elbow, the joints are shoulder_pan"),
        ({"offsets": {"elbow": 3}}, "offsets names elbow"),
        ({"signs": {"elbow_flex": -2}}, "signs must be 1 or -1, got elbow_flex=-2"),
        ({"units": "normalized"}, "need LeRobot's calibration file"),
        ({"units": "radians", "motors": "{}"}, "units are radians"),
        ({"units": "normalized", "motors": "no"}, "cannot read"),
        ({"units": "normalized", "motors": "[]"}, "must map motors"),
        ({"units": "normalized", "motors": "{}"}, "lacks shoulder_pan, .*wrist_roll"),
        ({"units": "normalized", "motors": json.dumps(MOTORS | {"elbow_flex": {}})}, "elbow_flex needs range_min"),
        (
            {
                "units": "normalized",
                "motors": json.dumps(MOTORS | {"elbow_flex": MOTORS["gripper"] | {"range_max": 9}}),
            },
            "elbow_flex has a range from 800 to 9",
        ),
        (
            {
                "units": "normalized",
                "motors": json.dumps(MOTORS | {"elbow_flex": MOTORS["gripper"] | {"drive_mode": 1}}),
            },
            "elbow_flex has a drive_mode: say by signs",
        ),
    ],
)
def test_wrong_units_are_refused_in_words(tmp_path, options, message):
    if "motors" in options:
        file = tmp_path / "motors.json"
        file.write_text(options["motors"])
        options = options | {"motors": file}
    with pytest.raises(KinematicsError, match=message):
        joint_scales(so101(), JOINTS, **({"units": "degrees"} | options))


def test_degrees_and_radians_are_told_apart():
    states, _ = recording()
    check_positions(so101_arm(), states, "degrees")
    radians = so101_arm(scale=np.ones(5))
    check_positions(radians, np.deg2rad(states), "radians")
    with pytest.raises(KinematicsError, match=r"shoulder_pan goes from 0 to 40.* limits are -110 .*degrees taken for"):
        check_positions(radians, states, "radians")
    with pytest.raises(KinematicsError, match=r"no joint exceeds 1.*look like radians"):
        check_positions(so101_arm(), np.deg2rad(states), "degrees")
    with pytest.raises(KinematicsError, match=r"elbow_flex goes from .*a sign or an offset wrong"):
        check_positions(so101_arm(offset=np.deg2rad([0, 0, 90, 0, 0])), states, "degrees")
    with pytest.raises(KinematicsError, match="not finite"):
        check_positions(so101_arm(), states * np.nan, "degrees")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"state_names": NAMES[1:]}, "the state lacks shoulder_pan; it has shoulder_lift.pos"),
        ({"action_names": NAMES[:-1]}, "the action lacks gripper"),
        ({"action_names": (*NAMES, "base.vel")}, "the action has base.vel, which no joint of the arm takes"),
        ({"opened": 0.0}, "closed and open gripper different"),
        ({"scale": np.zeros(5)}, "scale not 0"),
        ({"offset": np.zeros(4)}, "a name, a scale and an offset for each of shoulder_pan"),
        ({"origin": np.full(3, np.nan)}, "must be finite"),
    ],
)
def test_a_contradictory_arm_is_refused_in_words(changes, message):
    with pytest.raises(KinematicsError, match=message):
        so101_arm(**changes)


def test_a_stored_arm_is_the_same_arm():
    arm = so101_arm()
    again = arm_from_plain(json.loads(json.dumps(arm.plain())))
    states, actions = recording()
    np.testing.assert_array_equal(again.states(states), arm.states(states))
    np.testing.assert_array_equal(again.increments(states, actions), arm.increments(states, actions))
    for change in ({"scale": "wide"}, {"joints": 3}, {"origin": [1]}, {"model": {}}):
        with pytest.raises(KinematicsError, match="a stored arm is malformed"):
            arm_from_plain(arm.plain() | change)
