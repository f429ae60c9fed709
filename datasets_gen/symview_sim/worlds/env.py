"""The Gymnasium environment of a simulator on MuJoCo."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Camera, invert_rigid
from lerobot_symview.geometry.placement import CameraSpec
from symview_sim.camera_rig import CameraImages, EnvObservation
from symview_sim.lens import pinhole_camera
from symview_sim.table_env import RENDER_HEIGHT, TableEnv
from symview_sim.worlds.base import MujocoSettings, MujocoWorld


class MujocoEnv(TableEnv):
    """A task of a simulator on MuJoCo; observations are those of `TableEnv`.

    Action: (4,) float32: dx, dy, dz, metres, in equal parts over the steps of `action_repeat`, and aperture in [0, 1].
    State: (4,) gripper x, y (metres, relative to the workspace centre), z (metres above the table), aperture.
    Reward: 1 when the task is solved, which ends the episode, else 0. `info["is_success"]` is the same as a bool.
    End: success, or `episode_steps` actions.

    Args:
        settings: task, workspace, cameras and limits.
        render_mode: `rgb_array` (or None); `render()` returns the first camera's image.
    """

    settings: MujocoSettings

    def __init__(self, settings: MujocoSettings, render_mode: str | None = "rgb_array"):
        largest = np.full(3, settings.max_motion * settings.action_repeat, dtype=np.float32)
        low, high = np.append(-largest, np.float32(0)), np.append(largest, np.float32(1))
        super().__init__(settings, settings.instruction, low, high, render_mode)
        self._world_from_model = settings.world_from_model
        self._model_from_world = invert_rigid(settings.world_from_model)
        self._world: MujocoWorld | None = None
        self._renderer: Any = None
        self._steps = 0

    @property
    def world(self) -> MujocoWorld:
        """The simulator. It starts at first use, so that an environment costs nothing before its first reset."""
        if self._world is None:
            self._world = self.settings.make_world()
        return self._world

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[EnvObservation, dict]:
        """Start an episode. All its randomness follows from `seed`."""
        super().reset(seed=seed)
        self._steps = 0
        self.world.reset(int(self.np_random.integers(2**31)))
        self._rig.start_episode(self.np_random)
        return self._observe(self._state()), {"is_success": False}

    def step(self, action: NDArray[np.floating]) -> tuple[EnvObservation, float, bool, bool, dict[str, Any]]:
        """Move the gripper by `action` (4,), clamped to the action space.

        Raises:
            ValueError: if the action is not four finite numbers; the environment is unchanged.
        """
        *motion, aperture = self._clipped(action)
        repeat = self.settings.action_repeat
        part = self._model_from_world[:3, :3] @ motion / repeat
        success = any(self.world.step(part, aperture) for _ in range(repeat))
        self._steps += 1
        truncated = self._steps >= self._max_episode_steps and not success
        return self._observe(self._state()), float(success), success, truncated, {"is_success": success}

    def expert_action(self) -> NDArray[np.float32]:
        """Return the expert's action in the current state, (4,) float32, held for `action_repeat` steps."""
        motion, aperture = self.world.expert_action()
        motion = self._world_from_model[:3, :3] @ motion * self.settings.action_repeat
        clipped: NDArray[np.float64] = np.clip(np.append(motion, aperture), self._action_low, self._action_high)
        return clipped.astype(np.float32)

    def close(self) -> None:
        """Free the renderer and the simulator."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = self._world = None

    def _state(self) -> list[float]:
        position, aperture = self.world.gripper()
        x, y, z = self._world_from_model[:3, :3] @ position + self._world_from_model[:3, 3]
        center_x, center_y = self.workspace.center
        return [x - center_x, y - center_y, z, aperture]

    def _draw(self, spec: CameraSpec, camera: Camera) -> CameraImages:
        if self._renderer is None:
            from symview_sim.worlds.rendering import MujocoRenderer

            resized = self.cameras[self.specs[0].name].resized(RENDER_HEIGHT)
            drawn = map(pinhole_camera, (*self.cameras.values(), resized))
            sizes = [(other.height, other.width) for other in drawn]
            self._renderer = MujocoRenderer(self.world.model, *map(max, zip(*sizes, strict=True)))
        return self._renderer.render(self.world.data, camera, self._model_from_world)
