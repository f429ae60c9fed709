"""A simulated scene, seen after a planar transform."""

from types import SimpleNamespace

import numpy as np


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
