from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_symview.geometry.placement import CameraSpec
from symview_sim import TASK_NAMES
from symview_sim.settings import EnvSettings

TINY = CameraSpec(height=8, width=8)


class TransformedScene:
    """A scene after a planar transform: a reflection y -> -y, then quarter turns about the workspace's centre."""

    def __init__(self, scene, quarter_turns, reflect):
        self._scene = scene
        self._angle, self._sign = quarter_turns * np.pi / 2, -1.0 if reflect else 1.0
        cosine, sine = round(np.cos(self._angle)), round(np.sin(self._angle))
        self.matrix = np.array([[cosine, -sine], [sine, cosine]]) @ np.diag([1.0, self._sign])
        arm = scene.arm
        yaw = (self.transformed_yaw(arm.yaw) + np.pi / 2) % np.pi - np.pi / 2
        self.arm = SimpleNamespace(position=self.transformed(arm.position), yaw=yaw, holds=arm.holds)

    def __getattr__(self, name):
        return getattr(self._scene, name)

    def transformed(self, position):
        center = np.asarray(self._scene.workspace.center)
        return np.append(center + self.matrix @ (position[:2] - center), position[2])

    def transformed_yaw(self, yaw):
        return self._sign * yaw + self._angle

    def transformed_action(self, action):
        return np.array([*(self.matrix @ action[:2]), action[2], self._sign * action[3], action[4]])

    def pose(self, body):
        position, yaw = self._scene.pose(body)
        return self.transformed(position), self.transformed_yaw(yaw)


@pytest.mark.parametrize("reflect", [False, True], ids=["rotated", "reflected"])
@pytest.mark.parametrize("task", TASK_NAMES)
def test_experts_are_equivariant_to_rotations_and_reflections(task, reflect):
    env = EnvSettings(task, camera=TINY, start_jitter=0.05).make()
    compared = 0
    for seed in range(3):
        env.reset(seed=seed)
        done = False
        while not done:
            action = env.expert_action()
            for quarter_turns in range(4):
                scene = TransformedScene(env.scene, quarter_turns, reflect)
                np.testing.assert_allclose(
                    env.episode_task.expert_action(scene),
                    scene.transformed_action(action),
                    atol=1e-6,
                    err_msg=f"seed {seed}",
                )
                compared += 1
            _, _, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
    assert compared > 50
