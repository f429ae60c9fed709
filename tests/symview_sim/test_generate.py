import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset

from lerobot_symview import keys
from lerobot_symview.cli import CommandError, DatasetTarget
from lerobot_symview.placement import CameraSpec
from symview_sim.demonstration import episode_seed
from symview_sim.env import SymviewEnv
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from tests.conftest import EPISODES


def test_the_dataset_holds_what_the_environment_showed(recorded):
    dataset = LeRobotDataset("test/recorded", root=recorded, depth_output_unit="m")
    env = SymviewEnv("block_picking", oracle=True)
    index = 0
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=episode_seed(0, episode))
        done = False
        while not done:
            item = dataset[index]
            assert item["episode_index"] == episode
            for name in ("side", "top"):
                rgb = (item[keys.rgb(name)] * 255).round().byte().permute(1, 2, 0).numpy()
                np.testing.assert_array_equal(rgb, observation["pixels"][name])
                np.testing.assert_array_equal(item[keys.depth(name)].numpy(), observation[f"images.{name}_depth"])
            np.testing.assert_array_equal(item[keys.STATE].numpy(), observation["agent_pos"])
            np.testing.assert_array_equal(
                item[keys.world_from_cam("side")].numpy(), observation["camera.side.world_from_cam"]
            )
            action = env.expert_action()
            np.testing.assert_array_equal(item[keys.ACTION].numpy(), action)
            observation, reward, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            assert item["next.reward"].item() == reward
            assert item["next.done"].item() == done
            assert item["next.success"].item() == info["is_success"]
            index += 1
    assert index == len(dataset)


def test_every_episode_ends_in_success(recorded):
    dataset = LeRobotDataset("test/recorded", root=recorded)
    last = [int(i) - 1 for i in dataset.meta.episodes["dataset_to_index"]]
    assert len(last) == EPISODES
    assert all(dataset[i]["next.success"] for i in last)


def test_the_camera_is_a_choice(tmp_path):
    camera = CameraSpec(name="front", height=64, width=80, elevation_deg=30.0, azimuth_deg=20.0)
    target = DatasetTarget("test/front", tmp_path / "front")
    folder = generate(GenerateConfig(target, RecordedEnv(camera=camera, oracle=False), num_episodes=1))
    dataset = LeRobotDataset("test/front", root=folder)
    assert sorted(dataset.meta.camera_keys) == ["observation.images.front", "observation.images.front_depth"]
    assert dataset.meta.features["observation.images.front"]["info"]["symview"]["placement"]["elevation_deg"] == 30.0


def test_an_existing_dataset_is_not_overwritten(recorded):
    with pytest.raises(CommandError, match="exists already"):
        generate(GenerateConfig(DatasetTarget("test/recorded", recorded), num_episodes=1))


def test_a_failure_leaves_nothing_behind(tmp_path):
    camera = CameraSpec(fov_deg=5.0)
    with pytest.raises(ValueError, match="of the workspace"):
        generate(GenerateConfig(DatasetTarget("test/none", tmp_path / "none"), RecordedEnv(camera=camera)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", [{"num_episodes": 0}, {"noise": 2.0}, {"seed": -1}])
def test_impossible_requests_are_refused(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        GenerateConfig(DatasetTarget("a/b"), **options)
