import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.envs.utils import preprocess_observation

from lerobot_policy_symview import SymviewEnvConfig
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.runtime.flag_errors import FlagError
from symview_sim import TASK_NAMES
from symview_sim.settings import EnvSettings

SMALL = CameraSpec(height=32, width=48)


def test_declared_features_match_a_recording(recorded):
    declared = SymviewEnvConfig(oracle=True).features
    stored = LeRobotDataset("test/recorded", root=recorded).meta.features
    for key, feature in declared.items():
        assert tuple(stored[key]["shape"]) == feature.shape


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"oracle": True},
        {"segmentation": True},
        {"depth": False},
        {"more_cameras": (CameraSpec("left", 24, 32, azimuth_deg=90.0),)},
    ],
    ids=str,
)
def test_observations_match_the_declared_features(options):
    config = SymviewEnvConfig(camera=SMALL, **options)
    env = config.create_envs(1)["block_picking"][0]
    observation, _ = env.reset(seed=0)
    batch = preprocess_observation(observation)
    visual = {key: feature.shape for key, feature in config.features.items() if feature.type == "VISUAL"}
    assert {key for key in batch if ".images." in key} == set(visual)
    for key, (height, width, channels) in visual.items():
        assert tuple(batch[key].shape) == (1, channels, height, width)
    env.close()


def test_preprocessor_adds_the_views():
    config = SymviewEnvConfig(camera=SMALL, views=["reproj", "persp"], view_size=40)
    env = config.create_envs(1)["block_picking"][0]
    processor, _ = config.get_env_processors()
    batch = processor(preprocess_observation(env.reset(seed=0)[0]))
    for name, channels in {"reproj": 3, "reproj_height": 1, "persp": 3, "persp_gripper": 3}.items():
        key = f"observation.images.side_{name}"
        assert tuple(batch[key].shape) == (1, channels, 40, 40)
        assert config.features[key].shape == (40, 40, channels)
    env.close()


def test_fine_control_gives_lerobot_its_rate_and_episode_length():
    config = SymviewEnvConfig(camera=SMALL, control="fine", style="human")
    env = config.create_envs(2)["block_picking"][0]
    assert (config.fps, env.call("_max_episode_steps")) == (10, (200, 200))
    assert env.envs[0].unwrapped.settings == EnvSettings(camera=SMALL, control="fine", style="human")
    assert env.single_action_space.high[0] == pytest.approx(0.015)
    with pytest.raises(FlagError, match=r"--env\.fps=4: the simulator takes 10 actions a second"):
        SymviewEnvConfig(control="fine", fps=4)
    env.close()


def test_view_that_needs_depth_raises_without_depth():
    with pytest.raises(FlagError, match="'reproj' needs depth"):
        SymviewEnvConfig(depth=False, views=["reproj"])


def test_all_tasks_or_a_list_form_a_suite():
    suite = SymviewEnvConfig(task="all", camera=SMALL).create_envs(2)
    assert set(suite) == set(TASK_NAMES)
    assert {env.num_envs for group in suite.values() for env in group.values()} == {2}
    several = SymviewEnvConfig(task="block_picking, drawer_opening", camera=SMALL).create_envs(1)
    assert list(several) == ["block_picking", "drawer_opening"]
    with pytest.raises(FlagError, match="did you mean 'drawer_opening'"):
        SymviewEnvConfig(task="block_picking, drawer_open").create_envs(1)


@pytest.mark.long
def test_asynchronous_environments_match_synchronous_ones_and_freeze_when_done():
    config = SymviewEnvConfig(camera=SMALL)
    asynchronous = config.create_envs(2, use_async_envs=True)["block_picking"][0]
    references = [EnvSettings("block_picking", camera=SMALL).make() for _ in range(2)]
    observations, _ = asynchronous.reset(seed=[5, 6])
    expected_observations = [env.reset(seed=seed)[0] for env, seed in zip(references, (5, 6), strict=True)]
    still = np.array([0, 0, 0, 0, 1], dtype=np.float32)
    for step in range(9):  # the first succeeds after seven, the second does not move
        for i in range(2):
            np.testing.assert_array_equal(observations["pixels"]["side"][i], expected_observations[i]["pixels"]["side"])
            np.testing.assert_array_equal(observations["agent_pos"][i], expected_observations[i]["agent_pos"])
        done = step >= 7
        action = still if done else references[0].expert_action()
        observations, reward, terminated, _, _ = asynchronous.step(np.stack([action, still]))
        expected_observations = [
            expected_observations[0] if done else references[0].step(action)[0],
            references[1].step(still)[0],
        ]
        assert reward.tolist() == [float(step == 6), 0.0]
        assert not terminated[1]
    asynchronous.close()
