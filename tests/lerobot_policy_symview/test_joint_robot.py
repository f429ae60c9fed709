"""A policy trained on a converted dataset drives a robot with joints, as LeRobot's rollout runs it."""

import numpy as np
import pytest
import torch
from lerobot.policies.factory import make_pre_post_processors
from lerobot.rollout.inference.sync import SyncInferenceEngine
from lerobot.utils.feature_utils import build_dataset_frame, hw_to_dataset_features

from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_symview import keys
from lerobot_symview.datasets.add_views import AddViewsConfig, add_views
from lerobot_symview.datasets.convert_actions import ConvertActionsConfig, convert_actions
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.datasets.robot_flags import RobotFlags
from lerobot_symview.kinematics.arm import pose_after
from lerobot_symview.kinematics.pose import differences
from tests.helpers.arms import CAMERAS, NAMES, arm_recording, record_arm, so101_arm
from tests.helpers.training import train

pytestmark = pytest.mark.long
OPTIONS = ("--policy.method=persp_equi", "--policy.camera=front", "--policy.max_joint_step=90")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot")
    (folder / "cameras.yaml").write_text(CAMERAS)
    source = HubDataset("test/arm", record_arm(folder / "arm", 2, 20))
    converted = convert_actions(
        ConvertActionsConfig(
            source, RobotFlags(preset="so101"), new_root=folder / "ee", calibration=folder / "cameras.yaml"
        )
    )
    views = AddViewsConfig(
        HubDataset("test/ee", converted), new_root=folder / "views", views=["persp"], camera="front", size=76
    )
    with pytest.MonkeyPatch.context() as patched:
        return train(patched, add_views(views), folder / "run", *OPTIONS)


def robot_observation(joints):
    image = np.random.default_rng(1).integers(256, size=(60, 80, 3), dtype=np.uint8)
    return dict(zip(NAMES, joints.tolist(), strict=True)) | {"front": image}


def test_the_checkpoint_alone_takes_joints_and_gives_joints(checkpoint):
    policy = SymviewBcPolicy.from_pretrained(checkpoint)
    policy.eval()
    before, after = make_pre_post_processors(policy.config, str(checkpoint))
    hardware = dict.fromkeys(NAMES, float)
    features = hw_to_dataset_features(hardware | {"front": (60, 80, 3)}, "observation", use_video=False)
    features |= hw_to_dataset_features(hardware, "action", use_video=False)
    engine = SyncInferenceEngine(
        policy=policy,
        preprocessor=before,
        postprocessor=after,
        dataset_features=features,
        ordered_action_keys=list(NAMES),
        task="stir",
        device="cpu",
        robot_type="so101_follower",
    )
    engine.reset()
    given = []
    hook = policy.select_action

    def select_action(batch):
        given.append((batch[keys.STATE].clone(), hook(batch)))
        return given[-1][1]

    policy.select_action = select_action
    arm = so101_arm(origin=np.array([0.25, 0.0, -0.02]))
    for joints in arm_recording(5)[0]:
        frame = build_dataset_frame(features, robot_observation(joints), prefix="observation")
        targets = engine.get_action(frame).numpy()
        state, _ = given[-1]
        np.testing.assert_allclose(state[0], arm.states(joints[None])[0], atol=1e-5)
        action = given[-1][1][0].numpy()
        error = differences(arm.targets(targets[None])[0], pose_after(arm.poses(joints[None])[0], action))
        assert np.abs(error[:3]).max() < 1e-4
        assert np.rad2deg(np.abs(error[3:5])).max() < 0.1
        assert targets[5] == pytest.approx(100 * np.clip(action[4], 0, 1), abs=0.01)


def test_flags_change_what_the_arm_may_do(checkpoint):
    from lerobot.configs.policies import PreTrainedConfig

    config = PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=["--max_joint_step=0.5"])
    policy = SymviewBcPolicy.from_pretrained(checkpoint, config=config)
    before, after = make_pre_post_processors(policy.config, policy.config.pretrained_path)
    joints = arm_recording(1)[0]
    image = torch.rand(1, 3, 60, 80)
    before({keys.STATE: torch.tensor(joints), keys.rgb("front"): image, "task": "stir"})
    found = after(torch.tensor([[0.01, 0.01, 0.0, 0.1, 1.0, 0.0]]))
    assert np.abs(found.numpy() - joints)[0, :5].max() == pytest.approx(0.5, abs=1e-3)
