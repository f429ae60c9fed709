from itertools import chain

import numpy as np
import pytest

from lerobot_symview.geometry.placement import CameraSpec
from symview_sim import TASK_NAMES
from symview_sim.control import CONTROLS, FINE
from symview_sim.robots import ROBOTS
from symview_sim.settings import EnvSettings
from symview_sim.shapes import HANDLE_REACH
from symview_sim.tasks.drawer_opening import BEHIND, HEIGHT
from tests.helpers.scenes import TransformedScene

TINY = CameraSpec(height=8, width=8)


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("reflect", [False, True], ids=["rotated", "reflected"])
@pytest.mark.parametrize("task", TASK_NAMES)
def test_experts_are_equivariant_to_rotations_and_reflections(task, reflect, control):
    env = EnvSettings(task, control=control, camera=TINY, start_jitter=0.05).make()
    compared = 0
    for seed in range(3 if control == "coarse" else 1):
        env.reset(seed=seed)
        done = False
        while not done:
            action = env.episode_task.expert_action(env.scene)
            for quarter_turns in range(4):
                scene = TransformedScene(env.scene, quarter_turns, reflect)
                np.testing.assert_allclose(
                    env.episode_task.expert_action(scene),
                    scene.transformed_action(action),
                    atol=1e-6,
                    err_msg=f"seed {seed}",
                )
                compared += 1
            _, _, terminated, truncated, _ = env.step(env.expert_action())
            done = terminated or truncated
    assert compared > 50


@pytest.mark.parametrize("yaw_error_deg", [0, 30, 60, 90])
@pytest.mark.parametrize("robot", ROBOTS)
def test_only_fingers_touch_the_cabinet_whatever_the_yaw(robot, yaw_error_deg):
    env = EnvSettings("drawer_opening", robot=robot, camera=TINY).make()
    touched = set()
    for seed in range(4):
        env.reset(seed=seed)
        client, arm = env.scene.client, env.scene.arm
        cabinet = client.getBodyUniqueId(client.getNumBodies() - 1)
        position, yaw = env.scene.pose(cabinet)
        inward = np.array([np.cos(yaw), np.sin(yaw)])
        behind = position[:2] - (HANDLE_REACH - BEHIND) * inward
        for place, height in ((behind, HEIGHT + 0.1), (behind, HEIGHT), (behind - 0.1 * inward, HEIGHT)):
            arm.move([*place, height], yaw + np.pi / 2 + np.deg2rad(yaw_error_deg), 0.0)
            touched |= {contact[3] for contact in client.getContactPoints(arm.body, cabinet)}
    env.close()
    assert touched
    assert touched <= set(chain(*ROBOTS[robot].finger_links))


@pytest.mark.long
@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("task", TASK_NAMES)
def test_experts_solve_the_tasks_in_fine_actions(task, robot):
    env = EnvSettings(task, robot=robot, control="fine", camera=TINY).make()
    for seed in range(5):
        env.reset(seed=seed)
        done, steps = False, 0
        while not done:
            action = env.expert_action()
            assert (np.abs(action[:4]) <= FINE.limits + 1e-7).all()
            _, _, terminated, truncated, info = env.step(action)
            done, steps = terminated or truncated, steps + 1
        assert info["is_success"]
        assert 25 <= steps <= 100
