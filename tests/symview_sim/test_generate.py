import filecmp
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_tools import merge_datasets

from lerobot_symview import keys
from lerobot_symview.datasets.add_views import AddViewsConfig, add_views
from lerobot_symview.datasets.card import dataset_card
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.datasets.metadata import EPISODE_STYLE, RECORDING, episode_styles, read_settings
from lerobot_symview.datasets.source import SourceDataset
from lerobot_symview.errors import DatasetError
from lerobot_symview.geometry.placement import CameraSpec, CameraSpread
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import CommandError
from lerobot_symview.runtime.staging import new_result, open_partial, plain
from symview_sim import recording
from symview_sim.demonstration import demonstrate, episode_seed
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import EnvSettings, NewDataset
from tests.conftest import EPISODES
from tests.helpers.datasets import contents
from tests.helpers.files import largest_file

pytestmark = pytest.mark.long

SMALL = RecordedEnv(camera=CameraSpec(height=32, width=32), oracle=False)
COMMAND = Path(sys.executable).parent / "symview-generate"


def config(root, **options):
    defaults = {"env": SMALL, "num_episodes": 5}
    return GenerateConfig(NewDataset("test/small", root), **(defaults | options))


def assert_same_data(folder, other):
    """Compare tables by value, since their metadata contains a hash of the folder's name, and other files by bytes."""
    files, others = ({p.relative_to(f) for p in f.rglob("*") if p.is_file()} for f in (folder, other))
    assert files == others
    for file in files:
        if file.suffix == ".parquet":
            assert pq.read_table(folder / file).equals(pq.read_table(other / file)), file
        else:
            assert filecmp.cmp(folder / file, other / file, shallow=False), file


@pytest.fixture(scope="module")
def small_shards():
    """Three shards of five episodes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "SHARD_EPISODES", 2)
        yield


@pytest.fixture(scope="module")
def reference(small_shards, tmp_path_factory):
    return generate(config(tmp_path_factory.mktemp("reference") / "data"))


def test_the_dataset_contains_the_environments_observations(recorded):
    dataset = LeRobotDataset("test/recorded", root=recorded, depth_output_unit="m")
    env = EnvSettings("block_picking", oracle=True).make()
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


def test_cameras_are_configurable_and_described_in_the_metadata(tmp_path):
    front = CameraSpec("front", 64, 80, elevation_deg=50.0, spread=CameraSpread(azimuth_deg=180.0))
    left = CameraSpec("left", 48, 48, azimuth_deg=90.0)
    env = RecordedEnv(task="drawer_opening", camera=front, more_cameras=(left,), oracle=False, segmentation=True)
    folder = generate(config(tmp_path / "data", env=env, num_episodes=2, seed=3, noise=0.05))
    dataset = LeRobotDataset("test/small", root=folder)
    names = ("front", "front_depth", "front_segmentation", "left", "left_depth", "left_segmentation")
    assert sorted(dataset.meta.camera_keys) == [f"observation.images.{name}" for name in names]
    assert dataset[0][keys.rgb("front")].shape == (3, 64, 80)
    starts = dataset.meta.episodes["dataset_from_index"]
    poses = [dataset[int(start)][keys.world_from_cam("front")].numpy() for start in starts]
    assert np.abs(poses[0] - poses[1]).max() > 0.05
    settings = read_settings(folder, RECORDING)
    assert (settings["seed"], settings["noise"]) == (3, 0.05)
    assert (settings["env"]["task"], settings["env"]["robot"]) == ("drawer_opening", "panda")
    assert settings["env"]["camera"]["spread"]["azimuth_deg"] == 180.0
    assert settings["pybullet"].startswith("3.")
    assert 0.5 < settings["expert_success_rate"] <= 1.0
    assert dataset.meta.features[keys.rgb("front")]["info"]["symview"] == {"workspace": plain(asdict(Workspace()))}
    assert dataset.meta.features[keys.segmentation("left")]["info"]["symview"]["labels"]["1"] == "robot"


def test_video_is_lossless_in_rgb_and_within_a_fifth_of_a_millimetre_in_depth(tmp_path):
    camera = CameraSpec(height=64, width=64, depth_noise=0.01, depth_dropout=0.1)
    env = RecordedEnv(camera=camera, segmentation=True)
    folder = generate(config(tmp_path / "data", env=env, num_episodes=1, video=True))
    dataset = LeRobotDataset("test/small", root=folder, depth_output_unit="m", video_backend="pyav")
    videos = {key for key, feature in dataset.meta.features.items() if feature["dtype"] == "video"}
    assert videos == set(dataset.meta.camera_keys) - {keys.depth("top")}
    episode = demonstrate(env, 0, 0, 0.0).frames
    for index in range(len(dataset)):
        item = dataset[index]
        for key in dataset.meta.camera_keys:
            stored, expected = item[key].permute(1, 2, 0).numpy(), episode[key][index]
            if expected.dtype == np.uint8:
                np.testing.assert_array_equal(np.rint(stored * 255), expected)
            else:
                assert np.abs(stored - expected)[expected <= recording.MAX_VIDEO_DEPTH].max(initial=0.0) < 2e-4
                np.testing.assert_array_equal(stored[expected == 0], 0.0)
    assert (episode[keys.depth("side")] == 0).any()


def test_a_camera_too_far_away_for_video_depth_is_refused(tmp_path):
    far = CameraSpec(distance=1.6, fov_deg=25.0)
    sometimes_far = CameraSpec(distance=1.42, fov_deg=30.0, spread=CameraSpread(azimuth_deg=180.0))
    for camera in (far, sometimes_far):
        with pytest.raises(ValueError, match="video=true stores depth up to"):
            generate(config(tmp_path / "data", env=RecordedEnv(camera=camera), video=True))


def test_the_number_of_workers_does_not_change_the_data(reference, tmp_path):
    assert_same_data(generate(config(tmp_path / "data", num_workers=2)), reference)


def test_a_ray_cluster_writes_the_same_data(reference, tmp_path):
    assert_same_data(generate(config(tmp_path / "data", num_workers=2, executor="ray")), reference)


def test_every_episode_names_its_style(small_shards, tmp_path):
    """Through shards, whichever worker simulated, a merge with a planner's episodes, and added views."""
    env = replace(SMALL, control="fine", style="human")
    alone = generate(config(tmp_path / "alone", env=env, num_episodes=3))
    parallel = generate(config(tmp_path / "parallel", env=env, num_episodes=3, num_workers=2))
    assert_same_data(alone, parallel)
    expected = [demonstrate(env, 0, episode, 0.0).style for episode in range(3)]
    dataset = LeRobotDataset("test/small", root=alone)
    assert dataset.fps == 10
    assert episode_styles(dataset.meta.episodes) == expected
    assert len({str(style) for style in expected}) == 3
    assert "It moves as people do" in dataset_card(SourceDataset(alone), "test/small", [], has_image=False)
    planner = generate(config(tmp_path / "planner", env=replace(SMALL, control="fine"), num_episodes=1))
    planned = LeRobotDataset("test/small", root=planner)
    assert EPISODE_STYLE not in planned.meta.episodes.column_names
    merge_datasets([planned, dataset], output_repo_id="test/both", output_dir=tmp_path / "both")
    source = HubDataset("test/both", tmp_path / "both")
    viewed = add_views(AddViewsConfig(source, new_repo_id="test/viewed", new_root=tmp_path / "viewed", size=32))
    for folder in (source.root, viewed):
        assert episode_styles(SourceDataset(folder).episodes) == [{}, *expected]


@pytest.mark.parametrize(
    ("text", "message"), [("{", "cannot read"), (3, "cannot read"), ("[1]", "must hold an object, got list")]
)
def test_a_style_that_is_no_object_is_an_error(text, message):
    with pytest.raises(DatasetError, match=message):
        episode_styles([{EPISODE_STYLE: text}])


def test_an_expert_with_noise_repeats_until_it_succeeds(small_shards, tmp_path):
    """The number of attempts depends on the episode, not on the worker."""
    folder = generate(config(tmp_path / "data", num_episodes=3, noise=0.9))
    attempts = [demonstrate(SMALL, 0, episode, 0.9).attempts for episode in range(3)]
    assert sum(attempts) > 3
    assert read_settings(folder, RECORDING)["expert_success_rate"] == pytest.approx(3 / sum(attempts))


def test_a_full_disk_is_reported_and_the_recording_can_be_resumed(reference, small_shards, tmp_path):
    root = tmp_path / "data"
    with largest_file(10_000), pytest.raises(CommandError, match=r"cannot write to .*MiB free.*--resume=true"):
        generate(config(root))
    assert not root.exists()
    assert not list((tmp_path / "data.partial" / "episodes").iterdir())
    assert_same_data(generate(config(root, resume=True)), reference)
    assert list(tmp_path.iterdir()) == [root]


def test_a_failed_image_write_of_lerobot_is_reported(small_shards, tmp_path):
    plan = _begun(tmp_path, env=RecordedEnv(oracle=False))
    with largest_file(50_000), pytest.raises(CommandError, match=r"Error writing image .*side_depth"):  # of 92 kB
        recording.write_shard(plan, range(2))
    assert not plan.shard_folder(range(2)).exists()


def test_an_interrupted_recording_needs_resume_and_the_same_request(small_shards, tmp_path):
    _begun(tmp_path)
    with pytest.raises(CommandError, match="add --resume=true"):
        generate(config(tmp_path / "data"))
    with pytest.raises(CommandError, match="run with different seed:"):
        generate(config(tmp_path / "data", seed=1, resume=True))
    with pytest.raises(CommandError, match="run with different env, features:"):
        generate(config(tmp_path / "data", env=replace(SMALL, segmentation=True), resume=True))


def test_a_second_run_is_refused_while_the_first_is_alive(tmp_path):
    with new_result(tmp_path / "data", {}, resume=False, flag="--dataset.root"):
        before = contents(tmp_path)
        for resume in (False, True):
            with pytest.raises(CommandError, match=rf"is being written by process {os.getpid()} .*--dataset\.root"):
                generate(config(tmp_path / "data", resume=resume))
        assert contents(tmp_path) == before
        (tmp_path / "data.partial" / "dataset").mkdir()


def test_leftovers_of_an_interrupted_clean_up_are_ignored(small_shards, tmp_path):
    plan = _begun(tmp_path)
    (plan.folder / "request.json").rename(plan.folder / "request.json.done")
    folder = generate(config(tmp_path / "data", num_episodes=1, seed=1))
    starts = LeRobotDataset("test/small", root=folder)[0][keys.ACTION].numpy()
    np.testing.assert_array_equal(starts, demonstrate(SMALL, 1, 0, 0.0).frames[keys.ACTION][0])


def test_resuming_a_complete_recording_does_nothing(reference):
    before = {path: path.stat().st_mtime_ns for path in reference.rglob("*")}
    assert generate(config(reference, resume=True)) == reference
    assert {path: path.stat().st_mtime_ns for path in reference.rglob("*")} == before
    with pytest.raises(CommandError, match="exists already"):
        generate(config(reference, resume=True, seed=1))


def test_a_recording_killed_at_any_time_resumes_and_writes_the_same_data(tmp_path, monkeypatch):
    """Two workers are killed during simulation, during writing and at random times."""
    root, partial = tmp_path / "data", tmp_path / "data.partial"
    command = [COMMAND, f"--root={root}", "--num_episodes=6", "--num_workers=2", "--resume=true"]
    command += ["--env.control=fine", "--env.style=human"]
    command += ["--env.oracle=false", "--env.camera.height=32", "--env.camera.width=32", "--dataset.repo_id=test/small"]
    dice = random.Random(0)
    milestones = [lambda n=n: len(list(partial.glob("episodes/*.npz"))) >= n for n in (1, 4)]
    milestones.append(lambda: any(partial.glob("shards/*.part/*")))
    kept = 0
    for reached in milestones:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while not reached():
            assert process.poll() is None
            time.sleep(0.02)
        time.sleep(0.2 * dice.random())
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert not root.exists()
        episodes = list(partial.glob("episodes/*.npz"))
        for file in episodes:
            with np.load(file) as content:
                assert content[keys.ACTION].shape[1] == 5
        assert len(episodes) >= kept
        kept = len(episodes)
    subprocess.run(command, check=True, capture_output=True)
    monkeypatch.setattr(recording, "SHARD_EPISODES", 25)  # as the command has it
    env = replace(SMALL, control="fine", style="human")
    expected = generate(config(tmp_path / "expected", env=env, num_episodes=6))
    assert_same_data(root, expected)


def test_a_dead_worker_raises_a_clear_error(small_shards, tmp_path):
    from lerobot_symview.runtime.executors import ProcessExecutor

    with (
        ProcessExecutor(1, "symview_sim.recording") as executor,
        pytest.raises(CommandError, match="worker process died"),
    ):
        list(executor.run(os._exit, [1]))


def test_an_existing_dataset_is_not_overwritten(recorded):
    with pytest.raises(CommandError, match="exists already"):
        generate(GenerateConfig(NewDataset("test/recorded", recorded), num_episodes=1))


def test_a_refused_request_leaves_nothing_behind(tmp_path):
    with pytest.raises(ValueError, match="of the workspace"):
        generate(config(tmp_path / "none", env=RecordedEnv(camera=CameraSpec(fov_deg=5.0))))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", [{"num_episodes": 0}, {"noise": 2.0}, {"seed": -1}, {"num_workers": 0}])
def test_invalid_options_are_refused(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        GenerateConfig(NewDataset("a/b"), **options)


def _begun(folder, **options):
    """Begin a recording in `folder`, simulate two of its five episodes and return its description for workers."""
    from symview_sim import generate as module

    plan = module.plan_recording(config(folder / "data", **options), folder / "data")
    open_partial(plan.folder, plan.description(), resume=False)
    for episode in range(2):
        recording.record_episode(plan, episode)
    return plan
