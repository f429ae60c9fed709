from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_symview.geometry.placement import CameraSpec
from symview_sim import TASK_NAMES
from symview_sim.settings import EnvSettings

TINY = CameraSpec(height=8, width=8)


class MovedScene:
    """A scene as it would be, turned by quarter turns about the workspace's centre after a mirroring y -> -y."""

    def __init__(self, scene, quarter_turns, mirror):
        self._scene = scene
        self._angle, self._sign = quarter_turns * np.pi / 2, -1.0 if mirror else 1.0
        cosine, sine = round(np.cos(self._angle)), round(np.sin(self._angle))
        self.matrix = np.array([[cosine, -sine], [sine, cosine]]) @ np.diag([1.0, self._sign])
        arm = scene.arm
        yaw = (self.turned(arm.yaw) + np.pi / 2) % np.pi - np.pi / 2
        self.arm = SimpleNamespace(position=self.moved(arm.position), yaw=yaw, holds=arm.holds)

    def __getattr__(self, name):
        return getattr(self._scene, name)

    def moved(self, position):
        center = np.asarray(self._scene.workspace.center)
        return np.append(center + self.matrix @ (position[:2] - center), position[2])

    def turned(self, yaw):
        return self._sign * yaw + self._angle

    def moved_action(self, action):
        return np.array([*(self.matrix @ action[:2]), action[2], self._sign * action[3], action[4]])

    def pose(self, body):
        position, yaw = self._scene.pose(body)
        return self.moved(position), self.turned(yaw)


@pytest.mark.parametrize("mirror", [False, True], ids=["turned", "mirrored"])
@pytest.mark.parametrize("task", TASK_NAMES)
def test_a_turned_or_mirrored_scene_gives_the_turned_or_mirrored_action(task, mirror):
    env = EnvSettings(task, camera=TINY, start_jitter=0.05).make()
    compared = 0
    for seed in range(3):
        env.reset(seed=seed)
        done = False
        while not done:
            action = env.expert_action()
            for quarter_turns in range(4):
                scene = MovedScene(env.scene, quarter_turns, mirror)
                np.testing.assert_allclose(
                    env._task.expert_action(scene), scene.moved_action(action), atol=1e-6, err_msg=f"seed {seed}"
                )
                compared += 1
            _, _, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
    assert compared > 50
