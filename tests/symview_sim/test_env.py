import subprocess
import sys
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from lerobot_symview.geometry.miscalibration import Miscalibration
from lerobot_symview.geometry.placement import CameraSpec, CameraSpread
from symview_sim import TASK_NAMES, gym_id
from symview_sim.demonstration import episode_seed
from symview_sim.robots import ROBOTS
from symview_sim.settings import EnvSettings

DIGEST = """
import hashlib, sys
from symview_sim.demonstration import episode_seed
from symview_sim.settings import EnvSettings
env = EnvSettings(sys.argv[1], oracle=True).make()
digest = hashlib.sha256()
for seed in (3, 4):
    observation, _ = env.reset(seed=seed)
    for _ in range(4):
        observation, *_ = env.step(env.expert_action())
        digest.update(observation["pixels"]["side"].tobytes() + observation["images.side_depth"].tobytes())
        digest.update(observation["agent_pos"].tobytes())
sys.stdout.write(digest.hexdigest())
"""


# Mean length of the experts' episodes in BulletArm, where these tasks come from.
REFERENCE_LENGTHS = {
    "block_in_bowl": 12.7,
    "block_picking": 7.0,
    "block_pulling": 8.5,
    "block_pushing": 9.4,
    "block_stacking": 13.3,
    "drawer_opening": 8.7,
}


TINY = CameraSpec(height=8, width=8)
SIDE, LEFT = CameraSpec(height=32, width=32), CameraSpec("left", height=24, width=40, azimuth_deg=90.0)
MOVING = replace(SIDE, spread=CameraSpread(azimuth_deg=180.0, elevation_deg=10.0))
NOISY = replace(SIDE, depth_noise=0.002, depth_dropout=0.02)
MODES = {
    "rgbd": {"camera": SIDE},
    "rgb": {"camera": SIDE, "depth": False},
    "segmentation": {"camera": SIDE, "segmentation": True},
    "oracle": {"camera": SIDE, "oracle": True},
    "two cameras": {"camera": SIDE, "more_cameras": (LEFT,)},
    "camera with a spread": {"camera": MOVING},
    "noisy depth": {"camera": NOISY},
    "all": {
        "camera": replace(MOVING, depth_noise=0.002),
        "more_cameras": (LEFT,),
        "oracle": True,
        "segmentation": True,
    },
}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("task", TASK_NAMES)
def test_gymnasiums_environment_checker_passes(task, mode):
    env = gymnasium.make(gym_id(task), **MODES[mode]).unwrapped
    check_env(env, skip_render_check=True)
    env.close()


def test_cameras_do_not_change_the_scene_of_a_seed():
    states = []
    for mode in MODES.values():
        env = EnvSettings("block_pushing", **mode).make()
        states.append(_expert_states(env, 3))
        env.close()
    for state in states[1:]:
        np.testing.assert_array_equal(state, states[0])


def test_a_camera_with_a_spread_moves_between_episodes_and_reports_its_pose():
    env = EnvSettings("block_picking", camera=MOVING).make()
    poses = []
    for seed in (0, 1, 0):
        observation, _ = env.reset(seed=seed)
        after, *_ = env.step(env.expert_action())
        poses.append(observation["camera.side.world_from_cam"])
        np.testing.assert_array_equal(after["camera.side.world_from_cam"], poses[-1])
    assert np.abs(poses[0] - poses[1]).max() > 0.1
    np.testing.assert_array_equal(poses[0], poses[2])


def test_segmentation_labels_table_robot_and_objects():
    env = EnvSettings("block_picking", oracle=True, segmentation=True).make()
    for seed in range(2):  # bodies get new ids in every episode
        pixels = env.reset(seed=seed)[0]["pixels"]
        labels = pixels["side_segmentation"]
        assert set(np.unique(labels)) == {0, 1, 2}
        np.testing.assert_array_equal(labels[..., 0], labels[..., 2])
        red = pixels["side"][..., 0] > 2.0 * pixels["side"][..., 1]
        np.testing.assert_array_equal(labels[..., 0] == 2, red)
        assert set(np.unique(pixels["top_segmentation"])) == {0, 2}


def test_segmentation_does_not_change_images_and_depth():
    """Without labels the renderer does less: it recognises drawn pixels by their depth."""
    settings = EnvSettings("block_in_bowl", camera=SIDE)
    plain, labelled = settings.make(), replace(settings, segmentation=True).make()
    for seed in range(2):
        expected, actual = (env.reset(seed=seed)[0] for env in (plain, labelled))
        np.testing.assert_array_equal(actual["pixels"]["side"], expected["pixels"]["side"])
        np.testing.assert_array_equal(actual["images.side_depth"], expected["images.side_depth"])


def test_depth_noise_changes_only_the_depth_and_differs_in_every_frame():
    exact, noisy = EnvSettings("block_picking", camera=SIDE).make(), EnvSettings("block_picking", camera=NOISY).make()
    still = np.array([0, 0, 0, 0, 1], dtype=np.float32)
    depths = []
    for env in (exact, noisy):
        env.reset(seed=0)
        depths.append([env.step(still)[0]["images.side_depth"] for _ in range(2)])
        assert env.reset(seed=0)[0]["pixels"]["side"].any()
    error = depths[1][0] - depths[0][0]
    assert 0.0 < np.abs(error[depths[1][0] > 0]).max() < 0.02
    assert 0.01 < (depths[1][0] == 0).mean() < 0.2
    assert not np.array_equal(depths[1][0], depths[1][1])


def test_a_wrong_calibration_is_stated_anew_in_every_episode_and_changes_no_image():
    wrong = replace(SIDE, miscalibration=Miscalibration(position=0.02, rotation_deg=3.0, focal=0.01))
    exact, env = (EnvSettings("block_picking", camera=camera).make() for camera in (SIDE, wrong))
    stated = []
    for seed in range(2):
        expected, actual = exact.reset(seed=seed)[0], env.reset(seed=seed)[0]
        np.testing.assert_array_equal(actual["pixels"]["side"], expected["pixels"]["side"])
        np.testing.assert_array_equal(actual["images.side_depth"], expected["images.side_depth"])
        poses = [found["camera.side.world_from_cam"].reshape(4, 4) for found in (expected, actual)]
        assert np.linalg.norm(poses[1][:3, 3] - poses[0][:3, 3]) == pytest.approx(0.02, abs=1e-5)
        stated.append(poses[1])
        after = env.step(env.expert_action())[0]
        np.testing.assert_array_equal(after["camera.side.world_from_cam"].reshape(4, 4), poses[1])
    assert not np.allclose(*stated)


def test_late_images_are_those_of_earlier_actions():
    prompt, late = (EnvSettings("block_picking", camera=replace(SIDE, delay=delay)).make() for delay in (0, 2))
    observations = []
    for env in (prompt, late):
        seen = [env.reset(seed=0)[0]]
        for _ in range(4):
            seen.append(env.step(np.array([0, 0, -0.03, 0, 1], dtype=np.float32))[0])
        observations.append(seen)
    for step, observation in enumerate(observations[1]):
        earlier = observations[0][max(step - 2, 0)]
        np.testing.assert_array_equal(observation["pixels"]["side"], earlier["pixels"]["side"])
        np.testing.assert_array_equal(observation["images.side_depth"], earlier["images.side_depth"])
        np.testing.assert_array_equal(observation["agent_pos"], observations[0][step]["agent_pos"])
    assert not np.array_equal(observations[0][0]["pixels"]["side"], observations[0][2]["pixels"]["side"])
    again = late.reset(seed=0)[0]
    np.testing.assert_array_equal(again["pixels"]["side"], observations[0][0]["pixels"]["side"])


def test_a_distant_camera_renders_arm_and_objects():
    far = CameraSpec(distance=6.0, elevation_deg=30.0, fov_deg=6.0)
    env = EnvSettings("block_picking", camera=far, segmentation=True).make()
    pixels = env.reset(seed=0)[0]["pixels"]
    counts = np.bincount(pixels["side_segmentation"][..., 0].ravel(), minlength=3)
    assert (counts[1:] > 100).all()


def test_the_start_is_within_reach_for_any_jitter():
    env = EnvSettings("block_picking", camera=TINY, start_jitter=0.5).make()
    heights = [env.reset(seed=seed)[0]["agent_pos"][2] for seed in range(10)]
    assert min(heights) > 0.015
    assert max(heights) < 0.255


def test_render_returns_256_rows():
    env = EnvSettings("block_picking", camera=LEFT).make()
    env.reset(seed=0)
    assert env.render().shape == (256, 427, 3)


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_gripper_rotates_in_place_past_90_degrees(robot):
    env = EnvSettings("block_picking", robot=robot, camera=TINY).make()
    env.reset(seed=0)
    errors = []
    for direction in (1, -1):
        for _ in range(12):  # 540 degrees: past the wrist's limits, where it must rotate back by 180 degrees
            expected = env.scene.arm.yaw + direction * np.pi / 4
            env.step(np.array([0, 0, 0, direction * np.pi / 4, 1.0]))
            errors.append(abs((env.scene.arm.yaw - expected + np.pi / 2) % np.pi - np.pi / 2))
            np.testing.assert_allclose(env.scene.arm.position, [0.45, 0.0, 0.2], atol=0.005)
    assert max(errors) < 0.01


@pytest.mark.parametrize("task", TASK_NAMES)
def test_episodes_are_bit_identical_across_processes(task):
    digests = {
        subprocess.run([sys.executable, "-c", DIGEST, task], check=True, capture_output=True, text=True).stdout
        for _ in range(2)
    }
    assert len(digests) == 1
    assert len(digests.pop()) == 64


@pytest.mark.long
@pytest.mark.parametrize("task", TASK_NAMES)
def test_an_episode_does_not_depend_on_those_before_it(task):
    """Workers simulate episodes in any order, with the same result (Bullet violated this twice)."""
    ordered, disordered = EnvSettings(task).make(), EnvSettings(task).make()
    expected = [_expert_states(ordered, seed) for seed in range(5)]
    rng = np.random.default_rng(0)
    for seed in (4, 2, 2, 0, 3, 1):
        disordered.reset(seed=100 + seed)
        for _ in range(seed):  # an interrupted episode
            disordered.step(rng.uniform(disordered.action_space.low, disordered.action_space.high))
        np.testing.assert_array_equal(_expert_states(disordered, seed), expected[seed])


@pytest.mark.parametrize("task", TASK_NAMES)
def test_environments_in_one_process_are_independent(task):
    alone, first, second = (EnvSettings(task).make() for _ in range(3))
    expected = [alone.reset(seed=7)[0]["pixels"]["side"]]
    actual = [first.reset(seed=7)[0]["pixels"]["side"]]
    second.reset(seed=8)
    for _ in range(3):
        expected.append(alone.step(alone.expert_action())[0]["pixels"]["side"])
    for _ in range(3):
        actual.append(first.step(first.expert_action())[0]["pixels"]["side"])
        second.step(second.expert_action())
    np.testing.assert_array_equal(actual, expected)


def _expert_states(env, seed):
    states, done = [env.reset(seed=seed)[0]["agent_pos"]], False
    while not done:
        observation, _, terminated, truncated, _ = env.step(env.expert_action())
        states.append(observation["agent_pos"])
        done = terminated or truncated
    return np.array(states)


@pytest.mark.long
@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("task", TASK_NAMES)
def test_the_expert_succeeds(task, robot):
    env = EnvSettings(task, robot=robot).make()
    outcomes, lengths = [], []
    for seed in range(10):
        env.reset(seed=episode_seed(0, seed))
        done, steps = False, 0
        while not done:
            _, _, terminated, truncated, info = env.step(env.expert_action())
            done, steps = terminated or truncated, steps + 1
        outcomes.append(info["is_success"])
        lengths.append(steps)
    assert all(outcomes)
    assert np.mean(lengths) <= 1.2 * REFERENCE_LENGTHS[task]


@pytest.mark.parametrize(("control", "step", "yaw_step"), [("coarse", 0.05, np.pi / 4), ("fine", 0.015, np.pi / 12)])
def test_actions_are_clamped_to_the_action_space(control, step, yaw_step):
    env = EnvSettings("block_picking", control=control).make()
    before, _ = env.reset(seed=0)
    after, *_ = env.step(np.array([1.0, -1.0, 0.0, 10.0, 1.0]))
    moved = after["agent_pos"] - before["agent_pos"]
    np.testing.assert_allclose(moved[:3], [step, -step, 0.0], atol=0.004)
    assert moved[3] == pytest.approx(yaw_step, abs=0.03)
    assert env.metadata["render_fps"] == env.settings.actions_per_second


FINITE = [0.02, 0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([np.nan, 0, 0, 0, 1], r"must be finite: dx is nan$"),
        ([0, 0, np.inf, 0, -np.inf], "must be finite: dz is inf, aperture is -inf"),
        (np.full(5, np.nan, np.float16), "dx is nan, dy is nan, dz is nan, dyaw is nan, aperture is nan"),
        (FINITE[:4], r"must have the shape \(5,\) \(dx, dy, dz, dyaw, aperture\), got \(4,\)"),
        ([FINITE], r"got \(1, 5\)"),
        (None, r"got \(\)"),
        ([*FINITE[:4], "open"], r"must be 5 numbers \(dx, .*could not convert string to float: 'open'"),
        ([*FINITE[:4], 1j], "must be 5 numbers"),
        ([*FINITE[:4], [1.0]], "must be 5 numbers"),
    ],
    ids=str,
)
def test_an_invalid_action_is_refused_and_changes_nothing(action, message):
    env, expected = (EnvSettings("block_picking", camera=TINY).make() for _ in range(2))
    for each in (env, expected):
        each.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(action)
    for _ in range(2):
        np.testing.assert_array_equal(env.step(FINITE)[0]["agent_pos"], expected.step(FINITE)[0]["agent_pos"])


@pytest.mark.parametrize("largest", [1e30, 1e308])
def test_huge_actions_are_clamped(largest):
    env = EnvSettings("block_picking", camera=TINY).make()
    expected = _expert_states(env, 3)
    env.reset(seed=0)
    for signs in ([1, 1, -1, 1, 1], [-1, 1, 1, -1, -1]):
        assert np.isfinite(env.step(largest * np.array(signs))[0]["agent_pos"]).all()
    np.testing.assert_array_equal(_expert_states(env, 3), expected)


@pytest.mark.parametrize("spoil", ["target", "joint", "velocity", "object"])
def test_a_simulator_whose_state_is_not_finite_is_sound_after_a_reset(spoil):
    """`step` lets no such number in; whoever uses the scene can."""
    env = EnvSettings("block_picking", camera=TINY).make()
    expected = _expert_states(env, 3)
    env.reset(seed=0)
    client, arm = env.scene.client, env.scene.arm
    if spoil == "target":
        arm.move([np.nan] * 3, 0.0, 1.0)
    elif spoil == "object":
        client.resetBasePositionAndOrientation(client.getBodyUniqueId(client.getNumBodies() - 1), [np.nan] * 3, [0] * 4)
        env.scene.wait(5)
    else:
        client.resetJointState(arm.body, 0, *([np.nan] if spoil == "joint" else [0.0, np.nan]))
    np.testing.assert_array_equal(_expert_states(env, 3), expected)


def test_success_is_a_python_bool_on_reset_and_step():
    env = EnvSettings("block_picking").make()
    _, info = env.reset(seed=0)
    assert info["is_success"] is False
    *_, info = env.step(env.action_space.sample())
    assert type(info["is_success"]) is bool


def test_an_episode_ends_after_max_steps():
    env = EnvSettings("block_picking", max_steps=2).make()
    env.reset(seed=0)
    still = np.array([0, 0, 0, 0, 1], dtype=np.float32)
    assert env.step(still)[2:4] == (False, False)
    assert env.step(still)[2:4] == (False, True)


def test_start_jitter_changes_the_start_and_depends_on_the_seed():
    env = EnvSettings("block_picking", start_jitter=0.03).make()
    starts = [env.reset(seed=seed)[0]["agent_pos"][:3] for seed in (1, 2, 1)]
    assert not np.allclose(starts[0], starts[1], atol=1e-3)
    np.testing.assert_array_equal(starts[0], starts[2])


def test_importing_the_package_imports_no_simulator():
    code = (
        "import sys, symview_sim, lerobot_symview;sys.exit(bool({'pybullet', 'lerobot', 'torch'} & set(sys.modules)))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_gripper_reaches_its_target(robot):
    env = EnvSettings("block_picking", robot=robot).make()
    arm = env.scene.arm
    for x, y, z, yaw in [(0.45, 0.0, 0.2, 0.0), (0.25, -0.2, 0.03, 1.5), (0.65, 0.2, 0.02, -1.5)]:
        arm.reset((x, y, z), yaw)
        arm.move((x, y, z), yaw, 0.0)
        np.testing.assert_allclose([*arm.position, arm.yaw], [x, y, z, yaw], atol=0.003)
        assert arm.aperture == pytest.approx(0.0, abs=0.1)
