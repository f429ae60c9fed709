"""Simulators that others wrote, by LeRobot's own commands."""

import json
import sys

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.envs.utils import preprocess_observation
from lerobot.scripts import lerobot_eval

from lerobot_policy_symview import FetchEnvConfig, MetaWorldEnvConfig
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.runtime.flag_errors import FlagError
from symview_sim.generate import GenerateConfig, RecordedFetch, RecordedMetaWorld, generate
from symview_sim.settings import NewDataset
from tests.helpers.training import train

pytestmark = pytest.mark.long

CAMERA = {"height": 76, "width": 76, "azimuth_deg": 60.0, "distance": 1.0}
SMALL = CameraSpec(**CAMERA)
RECORDED = {"symview_metaworld": RecordedMetaWorld, "symview_fetch": RecordedFetch}
CONFIGS = {"symview_metaworld": MetaWorldEnvConfig, "symview_fetch": FetchEnvConfig}
TASKS = {"symview_metaworld": "push-v3", "symview_fetch": "FetchPush"}


@pytest.fixture(scope="module", params=RECORDED)
def recording(request, tmp_path_factory):
    root = tmp_path_factory.mktemp("foreign") / "data"
    dataset = NewDataset("test/foreign", root)
    return request.param, generate(GenerateConfig(dataset, RECORDED[request.param](camera=SMALL), num_episodes=2))


@pytest.mark.parametrize("kind", CONFIGS)
def test_observations_match_the_declared_features_and_views_are_added(kind):
    config = CONFIGS[kind](camera=SMALL, views=["reproj", "persp"], view_size=40)
    env = config.create_envs(1)[TASKS[kind]][0]
    batch = config.get_env_processors()[0](preprocess_observation(env.reset(seed=0)[0]))
    visual = {key: feature.shape for key, feature in config.features.items() if feature.type == "VISUAL"}
    assert {key for key in batch if ".images." in key} == set(visual)
    for key, (height, width, channels) in visual.items():
        assert tuple(batch[key].shape) == (1, channels, height, width)
    assert batch["observation.images.side_persp_gripper"].max() > 0
    assert config.fps == {"symview_metaworld": 16, "symview_fetch": 25}[kind]
    env.close()


def test_the_recording_is_the_same_with_two_workers(recording, tmp_path):
    kind, folder = recording
    dataset = NewDataset("test/foreign", tmp_path / "data")
    env = RECORDED[kind](camera=SMALL)
    again = generate(GenerateConfig(dataset, env, num_episodes=2, num_workers=2))
    first, second = (LeRobotDataset("test/foreign", root=root) for root in (folder, again))
    assert first.meta.features == second.meta.features
    assert first.fps == second.fps == env.actions_per_second
    for index in range(len(first)):
        for key, value in first[index].items():
            other = second[index][key]
            assert value == other if isinstance(value, str) else np.array_equal(value, other, equal_nan=True), key


def test_a_recording_trains_and_its_checkpoint_is_evaluated(recording, tmp_path, monkeypatch):
    """`lerobot-eval` in the same simulator; the checkpoint makes its view, and knows that the hand never turns."""
    kind, folder = recording
    checkpoint = train(monkeypatch, folder, tmp_path / "train", "--policy.method=reproj_equi")
    config = json.loads((checkpoint / "config.json").read_text())
    assert config["state_symmetry"] == config["action_symmetry"] == ["x", "y", "z", "aperture"]
    arguments = ["lerobot-eval", f"--policy.path={checkpoint}", "--policy.device=cpu", f"--env.type={kind}"]
    arguments += [f"--env.camera.{name}={value}" for name, value in CAMERA.items()]
    arguments += ["--env.max_steps=2", "--eval.n_episodes=2", "--eval.batch_size=2"]
    arguments += [f"--output_dir={tmp_path / 'eval'}"]
    monkeypatch.setattr(sys, "argv", arguments)
    lerobot_eval.main()
    assert json.loads((tmp_path / "eval" / "eval_info.json").read_text())["overall"]["n_episodes"] == 2


def test_an_unknown_task_is_a_flags_error():
    with pytest.raises(FlagError, match=r"--env: unknown task of Meta-World 'pus-v3'.*did you mean 'push-v3'"):
        MetaWorldEnvConfig(task="push-v3, pus-v3")
