"""The steps between joints and the gripper's poses: what the robot reaches, and what it refuses."""

import json

import numpy as np
import pytest
import torch
from lerobot.lerobot_types import TransitionKey
from lerobot.processor import PolicyProcessorPipeline, create_transition

from lerobot_policy_symview import JointsProcessorStep, JointTargetsProcessorStep
from lerobot_symview import keys
from lerobot_symview.errors import KinematicsError
from lerobot_symview.kinematics.arm import pose_after
from lerobot_symview.kinematics.pose import differences
from tests.helpers.arms import NAMES, arm_recording, so101_arm

ARM = so101_arm().plain()


@pytest.fixture
def steps():
    before, after = JointsProcessorStep(ARM), JointTargetsProcessorStep(ARM)
    yield before, after
    before.reset()


def observe(step, joints):
    return step.observation({keys.STATE: torch.tensor(joints, dtype=torch.float32)})[keys.STATE]


def test_a_recording_is_followed_there_and_back(steps):
    before, after = steps
    states, actions = arm_recording(30)
    increments = so101_arm().increments(states, actions)
    read = observe(before, states)
    np.testing.assert_allclose(read, so101_arm().states(states), atol=1e-5)
    found = after.action(torch.tensor(increments, dtype=torch.float32))
    assert found.shape == (30, len(NAMES))
    np.testing.assert_allclose(found, actions, atol=0.05)  # degrees, and per cent of the gripper


def test_the_observation_of_a_dataset_is_kept(steps):
    before, _ = steps
    state = torch.zeros(2, 6)
    transition = create_transition({keys.STATE: state}, torch.zeros(2, 6))
    assert before(transition)[TransitionKey.OBSERVATION][keys.STATE] is state
    with pytest.raises(KinematicsError, match="no joints were observed"):
        steps[1].action(torch.zeros(2, 6))


def test_steps_without_an_arm_change_nothing():
    state, action = torch.rand(2, 7), torch.rand(2, 3)
    assert JointsProcessorStep().observation({keys.STATE: state})[keys.STATE] is state
    assert JointTargetsProcessorStep().action(action) is action


def test_a_long_way_is_shortened_along_itself(steps):
    before, _ = steps
    states, _ = arm_recording(1)
    observe(before, states)
    far = torch.tensor([[0.03, 0.06, 0.0, 0.0, 1.0, 0.0]])
    whole = JointTargetsProcessorStep(ARM, max_step=360.0).action(far).numpy() - states
    part = JointTargetsProcessorStep(ARM, max_step=2.0).action(far).numpy() - states
    assert np.abs(part[0, :5]).max() == pytest.approx(2.0, abs=1e-4)
    np.testing.assert_allclose(part[0, :5] / 2.0, whole[0, :5] / np.abs(whole[0, :5]).max(), atol=1e-4)


def test_the_arm_holds_what_it_cannot_follow(steps, caplog):
    """At what was sent last, not at where it sags to; and it says so once."""
    before, after = steps
    states, actions = arm_recording(2)
    observe(before, states[:1])
    sent = after.action(torch.tensor(so101_arm().increments(states[:1], actions[:1]), dtype=torch.float32))
    sagged = states[:1] - np.array([[0, 1, 0, 0, 0, 0]], dtype=np.float32)
    for aperture in (0.2, 0.9):
        observe(before, sagged)
        held = after.action(torch.tensor([[0.5, 0.0, 0.0, 0.0, aperture, 0.0]]))
        np.testing.assert_allclose(held[0, :5], sent[0, :5], atol=1e-4)
        assert held[0, 5] == pytest.approx(100 * aperture, abs=1e-3)
    assert caplog.text.count("the arm holds") == 1
    strict = JointTargetsProcessorStep(ARM, unreachable="error")
    with pytest.raises(KinematicsError, match=r"cannot follow the action .*nearest that the joints reach is \d+ mm"):
        strict.action(torch.tensor([[0.5, 0.0, 0.0, 0.0, 1.0, 0.0]]))


def test_the_arm_leaves_its_rest_and_holds_where_yaw_is_undefined(steps, caplog):
    before, after = steps
    level = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 50.0]], dtype=np.float32)  # the fingers open up and down
    observe(before, level)
    moved = after.action(torch.tensor([[-0.01, 0.0, -0.01, 0.0, 0.5, 0.1]])).numpy()
    assert np.abs(moved - level)[0, :5].max() > 1
    folded = np.array([[0.0, -90.0, 0.0, 0.0, 0.0, 50.0]], dtype=np.float32)
    arm = so101_arm()
    assert arm.model.forward(arm.positions(folded))[0, 2, 2] > 0.98  # the fingers point up
    after.reset()
    observe(before, folded)
    held = after.action(torch.tensor([[0.01, 0.0, 0.0, 0.0, 0.5, 0.0]]))
    np.testing.assert_allclose(held, folded, atol=1e-4)
    assert "yaw or tilt is undefined" in caplog.text


def test_solutions_stay_within_the_limits(steps):
    before, after = steps
    model = so101_arm().model
    rng = np.random.default_rng(0)
    states, _ = arm_recording(20)
    observe(before, states)
    found = after.action(torch.tensor(rng.normal(0, 0.05, (20, 6)), dtype=torch.float32)).numpy()
    positions = np.deg2rad(found[:, :5])
    assert (positions >= model.lower - 1e-6).all()
    assert (positions <= model.upper + 1e-6).all()


def test_a_reset_forgets_the_joints(steps):
    before, after = steps
    observe(before, arm_recording(1)[0])
    before.reset()
    with pytest.raises(KinematicsError, match="no joints were observed before this action"):
        after.action(torch.zeros(1, 6))


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (np.zeros((1, 5)), r"has shape \(1, 5\), the robot of the recording gives 6 numbers: shoulder_pan.pos"),
        (np.full((1, 6), np.nan), "far outside its limits"),
        (np.array([[50, 0, 0, 0, 0, 170.0]])[:, ::-1], "shoulder_pan at 170 degrees.*must have the order shoulder_pan"),
    ],
)
def test_joints_of_another_robot_are_refused(steps, joints, message):
    with pytest.raises(KinematicsError, match=message):
        observe(steps[0], np.ascontiguousarray(joints))


@pytest.mark.parametrize(
    ("action", "message"), [([[0.0] * 5], "must be 6 finite numbers"), ([[np.nan] * 6], "must be 6 finite numbers")]
)
def test_an_action_that_is_none_is_refused(steps, action, message):
    observe(steps[0], arm_recording(1)[0])
    with pytest.raises(KinematicsError, match=message):
        steps[1].action(torch.tensor(action))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_step": 0.0}, "max_step and max_error must be positive, got 0.0"),
        ({"max_error": np.nan}, "must be positive, got .*nan"),
        ({"unreachable": "jump"}, "unreachable must be one of hold, error, got 'jump'"),
        ({"arm": {"joints": []}}, "a stored arm is malformed"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        JointTargetsProcessorStep(**({"arm": ARM} | options))


def test_a_pipeline_on_disk_has_the_same_steps(tmp_path, steps):
    before, _ = steps
    PolicyProcessorPipeline([before], name="before").save_pretrained(tmp_path)
    PolicyProcessorPipeline([JointTargetsProcessorStep(ARM, 5.0, 0.02, "error")], name="after").save_pretrained(
        tmp_path
    )
    stored = json.loads((tmp_path / "after.json").read_text())["steps"][0]
    loaded = JointTargetsProcessorStep(**stored["config"])
    assert (loaded.max_step, loaded.max_error, loaded.unreachable) == (5.0, 0.02, "error")
    states, _ = arm_recording(1)
    observe(before, states)
    increment = np.array([[0.002, -0.003, 0.001, 0.02, 0.5, 0.01]])
    found = loaded.action(torch.tensor(increment, dtype=torch.float32)).numpy()
    arm = so101_arm()
    reached = arm.targets(found)[0]
    error = differences(reached, pose_after(arm.poses(states)[0], increment[0]))
    assert np.abs(error[:3]).max() < 1e-4
    assert np.rad2deg(np.abs(error[3:5])).max() < 0.1
