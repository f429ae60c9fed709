"""The PyBullet environment: one task, one robot arm, any number of cameras."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict
from typing import Any, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from lerobot_symview import keys
from lerobot_symview.geometry.camera import Camera, intrinsics_from_fov, orbit_pose
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.registry import lookup
from lerobot_symview.runtime.staging import plain
from symview_sim.arm import Arm
from symview_sim.camera_rig import CameraImages, EnvObservation
from symview_sim.control import CONTROLS
from symview_sim.human_style import Hand, Style, draw_style, human_action
from symview_sim.rendering import render
from symview_sim.robots import ROBOTS
from symview_sim.scene import Scene
from symview_sim.settings import WRIST_SIZE, EnvSettings
from symview_sim.sight import place_in_sight
from symview_sim.table_env import TableEnv
from symview_sim.tasks import make_task

START_HEIGHT = 0.2  # metres
WRIST_ELEVATION, WRIST_FOV = np.deg2rad(55.0), np.deg2rad(75.0)  # of the camera on the gripper
WRIST_TARGET, WRIST_DISTANCE = (0.0, 0.0, -0.05), 0.21  # metres: what it looks at, from the fingertips, and from where
GRIPPER_HEIGHTS = (0.02, 0.25)  # metres, limits of the gripper's z; below 2 cm the fingers touch the table


class SymviewEnv(TableEnv):
    """A tabletop manipulation task in PyBullet; observations are those of `TableEnv`.

    With `wrist_camera`, `pixels["wrist"]` uint8 (96, 96, 3) is the image of a camera on the gripper. It turns with the
    arm's hand, by full turns, whereas the state's yaw is that of two equal fingers.

    Action: (5,) float32: dx, dy, dz (metres, each clamped to 0.05, or 0.015 with fine control), dyaw (radians, clamped
    to pi/4, or pi/12), aperture in [0, 1].
    State: (5,) gripper x, y (metres, relative to the workspace centre), z (metres), yaw (radians), aperture.
    Labels: 0 table, 1 robot, 2 and up objects.
    Reward: 1 when the task is solved, which ends the episode, else 0. `info["is_success"]` is the same as a bool.
    Start: gripper open, 20 cm above the workspace centre; objects at random poses; cameras with a spread at a new
    random pose.
    End: success, an object out of reach, or `episode_steps` actions.

    Args:
        settings: task, robot, workspace, cameras and limits.
        render_mode: `rgb_array` (or None); `render()` returns the first camera's image.

    Raises:
        CalibrationError: if a camera's image contains less than 60 % of the working volume; from `reset`, if the arm at
            its start hides more than 70 % of the workspace.
    """

    settings: EnvSettings

    def __init__(self, settings: EnvSettings, render_mode: str | None = "rgb_array"):
        self.episode_task = make_task(settings.task)
        self._control = CONTROLS[settings.control]
        limits = self._control.limits.astype(np.float32)
        low, high = np.append(-limits, np.float32(0)), np.append(limits, np.float32(1))
        super().__init__(settings, self.episode_task.instruction, low, high, render_mode)
        if settings.has_wrist_camera:
            pixels = cast(gymnasium.spaces.Dict, self.observation_space)["pixels"]
            image = gymnasium.spaces.Box(0, 255, (WRIST_SIZE, WRIST_SIZE, 3), np.uint8)
            cast(gymnasium.spaces.Dict, pixels)[keys.WRIST] = image
        self._robot = lookup("robot", settings.robot, ROBOTS)
        self._scene: Scene | None = None
        self._steps = 0
        self._style: Style | None = None
        self._hand = self._next_hand = Hand()
        corners = self.workspace.corners()
        self._reach = [np.append(corner[:2], z) for corner, z in zip(corners[[0, 2]], GRIPPER_HEIGHTS, strict=True)]

    @property
    def scene(self) -> Scene:
        """The simulator. It starts at first use, so that an environment costs nothing before its first reset."""
        if self._scene is None:
            self._scene = Scene(self._robot, self.workspace, self._control)
        return self._scene

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[EnvObservation, dict]:
        """Start an episode. All its randomness follows from `seed`."""
        super().reset(seed=seed)
        if self._scene is not None and not self._scene.arm.is_finite:
            self.close()  # Bullet keeps such numbers, whatever the joints are reset to
        self._steps = 0
        self._hand = self._next_hand = Hand()
        if self.settings.style == "human":  # from a generator of its own: the scene and the cameras stay the same
            generator = cast(np.random.PCG64, self.np_random.bit_generator)  # Gymnasium's
            style_rng = np.random.Generator(generator.jumped())
            self._style = draw_style(style_rng, self.episode_task.ways, self.episode_task.mistakes)
        largest = self.settings.start_jitter
        jitter = self.np_random.uniform(-largest, largest, size=3)
        start = np.array([*self.workspace.center, START_HEIGHT]) + jitter
        self.scene.reset(np.clip(start, *self._reach), gripper_yaw=0.0)
        self.episode_task.spawn(self.scene, self.np_random)
        self.scene.settle()
        self._rig.start_episode(self.np_random)
        return self._observe(self._state()), {"is_success": False}

    def step(self, action: NDArray[np.floating]) -> tuple[EnvObservation, float, bool, bool, dict[str, Any]]:
        """Move the gripper by `action` (5,), clamped to the action space.

        Raises:
            ValueError: if the action is not five finite numbers; the environment is unchanged.
        """
        arm = self.scene.arm
        *motion, aperture = self._clipped(action)
        arm.move(np.clip(arm.position + motion[:3], *self._reach), arm.yaw + motion[3], aperture)
        self._steps += 1
        self._hand = self._next_hand
        success = bool(self.episode_task.is_success(self.scene))
        terminated = success or not self.episode_task.is_valid(self.scene)
        truncated = self._steps >= self._max_episode_steps and not terminated
        return self._observe(self._state()), float(success), terminated, truncated, {"is_success": success}

    def expert_action(self) -> NDArray[np.float32]:
        """Return the expert's action in the current state, and in the style of the episode, (5,) float32."""
        if self._style is None:
            return self._control.planned(self.episode_task.expert_action(self.scene)).astype(np.float32)
        intent = self.episode_task.action_of_way(self.scene, self._style.way)
        seconds, height = self._steps / self._control.actions_per_second, float(self.scene.arm.position[2])
        action, self._next_hand = human_action(self._style, self._hand, seconds, intent, height, self._control)
        return action.astype(np.float32)

    @property
    def episode_style(self) -> dict[str, Any]:
        """The style of the episode's demonstration, as JSON values; {} for a planner's."""
        return {} if self._style is None else plain(asdict(self._style))

    def close(self) -> None:
        """Shut the simulator down."""
        if self._scene is not None:
            self._scene.close()
            self._scene = None

    def _state(self) -> list[float]:
        arm = self.scene.arm
        return [*(arm.position - (*self.workspace.center, 0.0)), arm.yaw, arm.aperture]

    def _observe(self, state: Sequence[float]) -> EnvObservation:
        """Return the observation, with the image of the camera on the gripper if there is one."""
        observation = super()._observe(state)
        if self.settings.has_wrist_camera:
            observation["pixels"][keys.WRIST] = render(self.scene.client, wrist_camera(self.scene.arm)).rgb
        return observation

    def _draw(self, spec: CameraSpec, camera: Camera) -> CameraImages:
        with nullcontext() if spec.sees_robot else self.scene.arm.hidden():
            return render(self.scene.client, camera, labelled=self.settings.segmentation)

    def _place(self, spec: CameraSpec, rng: np.random.Generator) -> Camera:
        return place_in_sight(spec, self.scene.client, self.workspace, rng)


def wrist_camera(arm: Arm) -> Camera:
    """Return the camera on the gripper, which sees both fingertips from the plane between them."""
    pose = orbit_pose(WRIST_ELEVATION, arm.heading + np.pi / 2, WRIST_DISTANCE, arm.position + WRIST_TARGET)
    return Camera(intrinsics_from_fov(WRIST_FOV, WRIST_SIZE, WRIST_SIZE), pose, WRIST_SIZE, WRIST_SIZE)


def make_env(render_mode: str | None = "rgb_array", **options: Any) -> SymviewEnv:
    """Return an environment; the entry point of `gymnasium.make`. `options` are the fields of `EnvSettings`."""
    return SymviewEnv(EnvSettings(**options), render_mode)
