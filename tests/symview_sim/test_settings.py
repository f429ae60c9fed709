"""The settings of an environment: one dataclass for Python, Gymnasium and the command line."""

import subprocess
import sys
from dataclasses import replace

import draccus
import gymnasium
import numpy as np
import pytest

from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.geometry.workspace import Workspace
from symview_sim import gym_id
from symview_sim.generate import GenerateConfig, RecordedEnv
from symview_sim.settings import EnvSettings

SIDE, LEFT = CameraSpec(height=32, width=32), CameraSpec("left", height=24, width=40, azimuth_deg=90.0)


def test_gymnasium_takes_the_fields_as_keyword_arguments():
    options = {"camera": replace(SIDE, elevation_deg=30.0), "more_cameras": (LEFT,), "robot": "kuka", "max_steps": 7}
    env = gymnasium.make(gym_id("drawer_opening"), **options).unwrapped
    assert env.settings == EnvSettings("drawer_opening", **options)
    assert list(env.cameras) == ["side", "left"]
    with pytest.raises(TypeError, match="cameras"):
        gymnasium.make(gym_id("drawer_opening"), cameras=(SIDE,))


def test_equal_settings_have_equal_hashes():
    assert hash(EnvSettings(camera=replace(SIDE))) == hash(EnvSettings(camera=SIDE))
    assert EnvSettings(camera=SIDE) != EnvSettings(camera=LEFT)


def test_the_control_sets_the_rate_and_the_length_of_an_episode():
    coarse, fine = EnvSettings(), EnvSettings(control="fine")
    assert (coarse.actions_per_second, coarse.episode_steps) == (4, 50)
    assert (fine.actions_per_second, fine.episode_steps) == (10, 200)
    assert replace(fine, max_steps=7).episode_steps == 7
    assert replace(coarse, control="fine") == fine


@pytest.mark.parametrize("flag", ["control=fine", "style=human"])
@pytest.mark.parametrize("kind", ["metaworld", "fetch"])
def test_other_simulators_have_no_control_and_no_style(kind, flag):
    with pytest.raises(draccus.utils.DecodingError, match=f"`{flag.split('=')[0]}` are not valid for Recorded"):
        draccus.parse(GenerateConfig, args=[f"--env.type={kind}", f"--env.{flag}"])


def test_a_recording_has_the_oracle_by_default():
    assert [spec.name for spec in RecordedEnv(more_cameras=(LEFT,)).all_cameras] == ["side", "left", "top"]
    assert [spec.name for spec in EnvSettings().all_cameras] == ["side"]


def test_the_command_line_sets_the_workspace():
    flags = ["--env.workspace.center=[0.5, -0.05]", "--env.workspace.size=0.3", "--env.task=block_pushing"]
    env = draccus.parse(GenerateConfig, args=flags).env
    assert env == RecordedEnv("block_pushing", workspace=Workspace((0.5, -0.05), 0.3))
    hash(env)


def test_the_task_happens_in_the_workspace():
    """The gripper starts above the centre, its position is relative to it, and the oracle shows the square."""
    workspace = Workspace((0.5, -0.05), 0.3)
    env = EnvSettings(camera=SIDE, oracle=True, workspace=workspace).make()
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        np.testing.assert_allclose(env.scene.arm.position, [0.5, -0.05, 0.2], atol=0.005)
        np.testing.assert_allclose(observation["agent_pos"][:2], 0.0, atol=0.005)
        top = observation["pixels"]["top"].astype(int)
        rows, columns = np.nonzero(top[..., 0] > 2 * top[..., 1])
        block = env.scene.pose(env.scene.client.getNumBodies() - 1)[0][:2]
        actual = workspace.xy_from_pixel(np.array([rows.mean(), columns.mean()]), len(top))
        np.testing.assert_allclose(actual, block, atol=0.01)
    env.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "block_piking"}, "unknown task 'block_piking'.*did you mean 'block_picking'"),
        ({"robot": "pandas"}, "unknown robot 'pandas'.*did you mean 'panda'"),
        ({"control": "fines"}, "unknown control 'fines'.*did you mean 'fine'"),
        ({"style": "humane"}, "unknown style 'humane'.*did you mean 'human'"),
        ({"start_jitter": -0.1}, "start_jitter must not be negative, got -0.1"),
        ({"max_steps": 0}, "max_steps must be at least 1, got 0"),
        ({"more_cameras": (SIDE,)}, "cameras must differ in their names, got side, side"),
        (
            {"more_cameras": (replace(LEFT, name="side_depth"),)},
            "'side_depth' is named like depth or a view of camera 'side'",
        ),
        ({"more_cameras": (replace(LEFT, name="top"),), "oracle": True}, "differ in their names, got side, top, top"),
    ],
)
def test_invalid_settings_are_refused(options, message):
    with pytest.raises(OptionError, match=message):
        EnvSettings(**options)


def test_a_camera_that_does_not_see_the_workspace_is_refused_when_the_environment_is_made():
    with pytest.raises(ValueError, match=r"sees .*% of the workspace, expected at least 60%"):
        EnvSettings(camera=CameraSpec(fov_deg=5.0)).make()


def test_importing_the_settings_imports_no_simulator_and_no_lerobot():
    heavy = ["pybullet", "numba", "lerobot", "cv2", "torch", "draccus"]
    code = f"import sys, symview_sim.settings; sys.exit(', '.join(set({heavy}) & set(sys.modules)) or None)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_pybullet_the_extra_is_named(monkeypatch):
    for module in (
        "symview_sim.env",
        "symview_sim.scene",
        "symview_sim.arm",
        "symview_sim.bullet",
        "symview_sim.rendering",
    ):
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'lerobot_policy_symview\[sim\]'"):
        EnvSettings().make()
