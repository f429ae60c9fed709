"""The camera on the gripper: turning the scene with the gripper leaves its image, reflecting it flips the image."""

import numpy as np
import pytest

from lerobot_policy_symview.symmetry.groups import make_group
from lerobot_symview import keys
from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.placement import CameraSpec
from symview_sim.env import wrist_camera
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.rendering import render
from symview_sim.settings import WRIST_SIZE, EnvSettings, NewDataset

D4 = make_group("D4")
GRIPPER, HEADING = np.array([0.05, 0.03, 0.15]), np.deg2rad(-70)
RED, GREEN, BLUE = (0.9, 0.1, 0.1), (0.1, 0.7, 0.1), (0.1, 0.1, 0.9)
BOXES = [((0.06, 0.03), RED, 0.3), ((0.0, 0.06), BLUE, 1.0), ((0.13, 0.01), GREEN, 0.0)]
TURN, LEFTMOST = np.deg2rad(45), np.deg2rad(209)  # of the wrist, which turns to one side farther than to the other


@pytest.fixture(scope="module")
def env():
    env = EnvSettings("block_picking", wrist_camera=True).make()
    env.reset(seed=0)
    yield env
    env.close()


def wrist_image(env, element):
    """Image (96, 96, 3) of a scene and a gripper that a group element transforms about the workspace's centre."""
    center, matrix = np.asarray(env.workspace.center), D4.rotation()[element]
    sign, angle = D4.determinants[element], D4.angle(element)
    scene, arm = env.scene, env.scene.arm
    position = np.array([*(center + matrix @ GRIPPER[:2]), GRIPPER[2]])
    # a reflected camera stands where the camera of a gripper stands that is half a turn further
    heading = angle + HEADING if sign > 0 else angle - HEADING - np.pi
    scene.reset(position, 0.0)
    turns = (heading - arm.heading + LEFTMOST) % (2 * np.pi) - LEFTMOST
    for step in range(1, int(np.ceil(abs(turns) / TURN)) + 1):  # a gripper turns to the nearer of two equal yaws
        arm.move(position, heading - turns + np.sign(turns) * min(step * TURN, abs(turns)), 1.0)
    assert abs((arm.heading - heading + np.pi) % (2 * np.pi) - np.pi) < 0.02
    np.testing.assert_allclose(arm.position, position, atol=0.002)
    for place, color, yaw in BOXES:
        at = (*(center + matrix @ place), 0.02)
        scene.add_box((0.04, 0.02, 0.04), 0.0, 0.5, color, at, angle + sign * yaw)
    return render(scene.client, wrist_camera(arm)).rgb.astype(float)


@pytest.mark.parametrize("element", range(1, D4.size))
def test_rotations_leave_the_image_and_reflections_flip_it(env, element):
    original, image = wrist_image(env, 0), wrist_image(env, element)
    expected, other = original, original[:, ::-1]
    if D4.reflects(element):
        expected, other = other, expected
    below = slice(WRIST_SIZE // 2, None)  # the arm, above, is where it is
    error, contrast = (np.abs(image - one)[below].mean() for one in (expected, other))
    assert error < 3
    assert contrast > 4 * error


def test_an_observation_has_the_image_and_episodes_stay_the_same(env):
    observation, _ = env.reset(seed=3)
    assert env.observation_space.contains(observation)
    plain = EnvSettings("block_picking").make()
    expected, _ = plain.reset(seed=3)
    plain.close()
    image = observation["pixels"].pop(keys.WRIST)
    assert image.shape == (96, 96, 3)
    np.testing.assert_equal(observation, expected)
    moved = env.step(np.array([0.0, 0.0, -0.05, 0.0, 1.0]))[0]["pixels"][keys.WRIST]
    assert np.abs(moved.astype(int) - image).mean() > 1


def test_a_recording_has_the_image_without_depth_and_calibration(tmp_path):
    from lerobot.datasets import LeRobotDataset

    env = RecordedEnv("block_picking", camera=CameraSpec(height=48, width=64), oracle=False, wrist_camera=True)
    folder = generate(GenerateConfig(NewDataset("test/wrist", tmp_path / "wrist"), env, num_episodes=1))
    dataset = LeRobotDataset("test/wrist", root=folder)
    assert dataset[0][keys.rgb(keys.WRIST)].shape == (3, 96, 96)
    assert [name for name in dataset.meta.features if "wrist" in name] == [keys.rgb(keys.WRIST)]


def test_another_camera_may_not_have_its_name():
    with pytest.raises(OptionError, match="wrist_camera adds the camera 'wrist', which another camera is called"):
        EnvSettings(camera=CameraSpec("wrist"), wrist_camera=True)
