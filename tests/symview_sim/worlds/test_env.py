import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.camera import project, unproject
from lerobot_symview.geometry.placement import CameraSpec, CameraSpread
from symview_sim.worlds.fetch import FetchSettings
from symview_sim.worlds.metaworld import MetaWorldSettings

SMALL = CameraSpec(height=40, width=56, azimuth_deg=60.0, distance=1.0)
WORLDS = {"metaworld": MetaWorldSettings, "fetch": FetchSettings}
# Solved of 10 at most as many actions as the median of 20 scenes, of the experts at 16 and 25 actions a second.
EXPERTS = {"push-v3": 13, "pick-place-v3": 12, "drawer-open-v3": 18, "FetchPush": 16}


def settings_of(world, **options):
    return WORLDS[world](camera=options.pop("camera", SMALL), **options)


def episode(env, seed, actions=None):
    """Return the observations of an episode of the expert, or of given actions; the actions; and the success."""
    observations, taken = [env.reset(seed=seed)[0]], []
    while True:
        taken.append(env.expert_action() if actions is None else actions[len(taken)])
        observation, _, terminated, truncated, info = env.step(taken[-1])
        observations.append(observation)
        if terminated or truncated:
            return observations, taken, info["is_success"]


@pytest.mark.parametrize("world", WORLDS)
def test_gymnasium_accepts_the_environment(world):
    env = settings_of(world).make()
    check_env(env, skip_render_check=False)
    assert env.render().shape == (256, 358, 3)
    env.close()


@pytest.mark.parametrize("task", EXPERTS)
def test_the_expert_succeeds(task):
    world = "fetch" if task == "FetchPush" else "metaworld"
    env = settings_of(world, task=task, depth=False).make()
    episodes = [episode(env, 10**9 + seed) for seed in range(10)]
    assert all(success for *_, success in episodes)
    assert np.median([len(actions) for _, actions, _ in episodes]) <= EXPERTS[task] + 2
    env.close()


@pytest.mark.parametrize("world", WORLDS)
def test_a_lens_bends_the_image_and_not_the_table(world):
    lens = replace(SMALL, distortion=(-0.3, 0.1, 0.0, 0.0))
    images, tables = [], []
    for camera in (SMALL, lens):
        env = settings_of(world, camera=camera).make()
        observation, _ = env.reset(seed=0)
        images.append(observation["pixels"]["side"])
        heights = unproject(observation["images.side_depth"][0], env.cameras["side"])[..., 2]
        tables.append(np.abs(heights) < 0.003)
        assert env.render().shape == (256, 358, 3)
        env.close()
    assert images[0].shape == images[1].shape
    assert (images[0] != images[1]).mean() > 0.1
    assert tables[1].mean() > 0.8 * tables[0].mean() > 0.1


@pytest.mark.parametrize("world", WORLDS)
def test_an_episode_follows_from_its_seed_alone(world):
    """The same images, bit for bit, first in a new environment and after other episodes; goals' markers included."""
    first, second = settings_of(world).make(), settings_of(world).make()
    observed, actions, _ = episode(first, 7)
    episode(second, 3)
    again, _, _ = episode(second, 7, actions)
    for one, other in zip(observed, again, strict=True):
        np.testing.assert_array_equal(one["pixels"]["side"], other["pixels"]["side"])
        np.testing.assert_array_equal(one["images.side_depth"], other["images.side_depth"])
        np.testing.assert_array_equal(one["agent_pos"], other["agent_pos"])


@pytest.mark.parametrize("world", WORLDS)
def test_an_action_moves_the_gripper_in_our_frame(world):
    """dx moves it away from the robot, dy to its left, in metres; the state says so."""
    env = settings_of(world).make()
    for axis, direction in enumerate(np.eye(3)):
        before = env.reset(seed=1)[0]["agent_pos"]
        for _ in range(4):
            after = env.step(np.append(0.02 * direction, 1.0))[0]["agent_pos"]
        moved = after[:3] - before[:3]
        assert 0.04 < moved[axis] < 0.09  # of 0.08: the arms lag
        assert np.abs(np.delete(moved, axis)).max() < 0.02


@pytest.mark.parametrize("world", WORLDS)
def test_the_state_is_where_the_image_shows_the_fingers(world):
    """The point between the fingertips projects onto pixels that change when the fingers move sideways."""
    env = settings_of(world, camera=CameraSpec(azimuth_deg=60.0, distance=1.0)).make()
    before = env.reset(seed=1)[0]
    after = env.step(np.array([0.0, 0.05, 0.0, 1.0], dtype=np.float32))[0]
    changed = (before["pixels"]["side"] != after["pixels"]["side"]).any(axis=-1)
    x, y, z = before["agent_pos"][:3]
    center_x, center_y = env.workspace.center
    (u, v), depth = project(np.array([x + center_x, y + center_y, z]), env.cameras["side"])
    assert depth > 0
    rows, columns = np.nonzero(changed)
    assert np.hypot(rows - v, columns - u).min() < 8
    assert np.percentile(rows, 99) == pytest.approx(v, abs=20)  # nothing lower in the image moves


def test_closing_an_environment_leaves_others_as_they_are():
    first, second = (settings_of("metaworld").make() for _ in range(2))
    expected = second.reset(seed=1)[0]["pixels"]["side"]
    first.reset(seed=0)
    first.close()
    np.testing.assert_array_equal(second.reset(seed=1)[0]["pixels"]["side"], expected)


def test_a_way_to_draw_that_is_not_there_is_an_error_in_one_line():
    command = [sys.executable, "-c", "from symview_sim.worlds.fetch import FetchSettings; FetchSettings().make()"]
    ended = subprocess.run(command, env=os.environ | {"MUJOCO_GL": "bad"}, capture_output=True, text=True, check=False)
    assert "CommandError: MuJoCo cannot draw with MUJOCO_GL=bad: invalid value" in ended.stderr


def test_cameras_of_other_sizes_and_places_see_the_same_table():
    left = CameraSpec("left", 24, 32, azimuth_deg=-60.0, distance=1.0)
    camera = CameraSpec(height=40, width=56, azimuth_deg=60.0, distance=1.0, spread=CameraSpread(azimuth_deg=20.0))
    env = settings_of("metaworld", camera=camera, more_cameras=(left,)).make()
    poses = []
    for seed in range(2):
        observation, _ = env.reset(seed=seed)
        assert observation["pixels"]["left"].shape == (24, 32, 3)
        poses.append(observation["camera.side.world_from_cam"])
        for name, placed in env.cameras.items():
            heights = unproject(observation[f"images.{name}_depth"][0], placed)[..., 2]
            assert (np.abs(heights) < 1e-3).mean() > 0.1  # the bare table
    assert not np.array_equal(*poses)
    env.close()


@pytest.mark.parametrize(
    ("world", "options", "message"),
    [
        ("metaworld", {"action_repeat": 0}, "action_repeat must be at least 1, got 0"),
        ("metaworld", {"max_steps": 0}, "max_steps must be at least 1"),
        ("metaworld", {"camera": CameraSpec(sees_robot=False)}, "sees_robot=false, which only PyBullet"),
        ("metaworld", {"more_cameras": (CameraSpec(),)}, "cameras must differ"),
        ("fetch", {"task": "FetchSlide"}, "unknown task 'FetchSlide', expected FetchPush"),
    ],
)
def test_invalid_settings_are_errors(world, options, message):
    with pytest.raises(OptionError, match=message):
        settings_of(world, **options)


def test_an_unknown_task_is_an_error_before_anything_is_simulated():
    with pytest.raises(ValueError, match=r"unknown task of Meta-World 'pus-v3', .* did you mean 'push-v3'"):
        MetaWorldSettings(task="pus-v3").make()


@pytest.mark.parametrize("action", [np.zeros(5), np.array([0.0, np.nan, 0.0, 0.0])])
def test_invalid_actions_are_errors(action):
    env = settings_of("fetch").make()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"\(dx, dy, dz, aperture\)|dy is nan"):
        env.step(action)


@pytest.mark.parametrize(("repeat", "rate"), [(1, 80), (5, 16), (8, 10)])
def test_an_action_moves_as_far_at_any_rate(repeat, rate):
    """The limit grows with the number of steps; a motion within it is the same."""
    env = settings_of("metaworld", action_repeat=repeat).make()
    assert env.metadata["render_fps"] == rate
    assert env.action_space.high[0] == pytest.approx(0.01 * repeat)
    start = env.reset(seed=2)[0]["agent_pos"]
    steps = round(0.04 / min(0.01, env.action_space.high[0]))
    for _ in range(steps):
        end = env.step(np.array([0.04 / steps, 0, 0, 1.0]))[0]["agent_pos"]
    for _ in range(20 // repeat):
        end = env.step(np.array([0, 0, 0, 1.0]))[0]["agent_pos"]
    assert end[0] - start[0] == pytest.approx(0.04, abs=0.006)
