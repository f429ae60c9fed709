"""The Gymnasium environment: one task, one robot arm, any number of cameras."""

from __future__ import annotations

from collections import deque
from contextlib import nullcontext
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_symview import keys
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.registry import lookup
from symview_sim.depth_sensor import degrade
from symview_sim.motions import MAX_STEP, MAX_YAW_STEP
from symview_sim.rendering import CameraImages, render
from symview_sim.robots import ROBOTS
from symview_sim.scene import Scene
from symview_sim.settings import EnvSettings
from symview_sim.sight import place_in_sight
from symview_sim.tasks import make_task

START_HEIGHT = 0.2  # metres
GRIPPER_HEIGHTS = (0.02, 0.25)  # metres, limits of the gripper's z; below 2 cm the fingers touch the table
RENDER_HEIGHT = 256  # pixels

EnvObservation = dict[str, Any]


class SymviewEnv(gymnasium.Env[EnvObservation, NDArray[np.float32]]):
    """A tabletop manipulation task with freely placed RGBD cameras.

    Action: (5,) float32: dx, dy, dz (metres, each clamped to 0.05), dyaw (radians, clamped to pi/4), aperture in
    [0, 1].
    Observation: `pixels[<camera>]` uint8 (H, W, 3); `images.<camera>_depth` float32 (1, H, W), metres along the optical
    axis, 0 = invalid; `pixels[<camera>_segmentation]` uint8 (H, W, 3), the same label in each channel: 0 table,
    1 robot, 2 and up objects; as the calibration states them, `camera.<camera>.intrinsics` float32 (9,), pixels,
    row-major, and `camera.<camera>.world_from_cam` float32 (16,), row-major; `agent_pos` float32 (5,): gripper x, y
    (metres, relative to the workspace centre), z (metres), yaw (radians), aperture.
    Reward: 1 when the task is solved, which ends the episode, else 0. `info["is_success"]` is the same as a bool.
    Start: gripper open, 20 cm above the workspace centre; objects at random poses; cameras with a spread at a new
    random pose.
    End: success, an object out of reach, or `max_steps` actions.

    Args:
        settings: task, robot, workspace, cameras and limits.
        render_mode: `rgb_array` (or None); `render()` returns the first camera's image.

    Raises:
        CalibrationError: if a camera's image contains less than 60 % of the working volume; from `reset`, if the arm at
            its start hides more than 70 % of the workspace.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012  gymnasium's own form

    def __init__(self, settings: EnvSettings, render_mode: str | None = "rgb_array"):
        self.settings = settings
        self.task, self.workspace = settings.task, settings.workspace
        self.episode_task = make_task(settings.task)
        self.task_description = self.episode_task.instruction
        self.render_mode = render_mode
        self._max_episode_steps = settings.max_steps  # LeRobot reads it under this name
        self._robot = lookup("robot", settings.robot, ROBOTS)
        self.specs = settings.all_cameras
        self.cameras = {spec.name: spec.place(self.workspace) for spec in self.specs}
        self._stated: dict[str, Camera] = {}  # the cameras as their calibration, which may be wrong, states them
        self._recent: dict[str, deque[CameraImages]] = {}
        self._placed = False
        self._scene: Scene | None = None
        self._steps = 0
        corners = self.workspace.corners()
        self._reach = [np.append(corner[:2], z) for corner, z in zip(corners[[0, 2]], GRIPPER_HEIGHTS, strict=True)]
        limits = np.array([MAX_STEP, MAX_STEP, MAX_STEP, MAX_YAW_STEP], dtype=np.float32)
        self._action_low, self._action_high = np.append(-limits, np.float32(0)), np.append(limits, np.float32(1))
        self.action_space = gymnasium.spaces.Box(self._action_low, self._action_high)
        self.observation_space = gymnasium.spaces.Dict(_observation_spaces(self.cameras, settings))

    @property
    def scene(self) -> Scene:
        """The simulator. It starts at first use, so that an environment costs nothing before its first reset."""
        if self._scene is None:
            self._scene = Scene(self._robot, self.workspace)
        return self._scene

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[EnvObservation, dict]:
        """Start an episode. All its randomness follows from `seed`."""
        super().reset(seed=seed)
        if self._scene is not None and not self._scene.arm.is_finite:
            self.close()  # Bullet keeps such numbers, whatever the joints are reset to
        self._steps = 0
        largest = self.settings.start_jitter
        jitter = self.np_random.uniform(-largest, largest, size=3)
        start = np.array([*self.workspace.center, START_HEIGHT]) + jitter
        self.scene.reset(np.clip(start, *self._reach), gripper_yaw=0.0)
        self.episode_task.spawn(self.scene, self.np_random)
        self.scene.settle()
        pose_rng, self._sensor_rng = self.np_random.spawn(2)  # cameras do not change the physics
        (calibration_rng,) = pose_rng.spawn(1)
        for spec in self.specs:
            if spec.varies or not self._placed:
                self.cameras[spec.name] = place_in_sight(spec, self.scene.client, self.workspace, pose_rng)
            camera = self.cameras[spec.name]
            self._stated[spec.name] = (
                spec.miscalibration.stated(camera, calibration_rng) if spec.miscalibration else camera
            )
            self._recent[spec.name] = deque(maxlen=spec.delay + 1)
        self._placed = True
        return self._observe(), {"is_success": False}

    def step(self, action: NDArray[np.floating]) -> tuple[EnvObservation, float, bool, bool, dict[str, Any]]:
        """Move the gripper by `action` (5,), clamped to the action space.

        Raises:
            ValueError: if the action is not five finite numbers; the environment is unchanged.
        """
        arm = self.scene.arm
        *motion, aperture = np.clip(checked_action(action), self._action_low, self._action_high)
        arm.move(np.clip(arm.position + motion[:3], *self._reach), arm.yaw + motion[3], aperture)
        self._steps += 1
        success = bool(self.episode_task.is_success(self.scene))
        terminated = success or not self.episode_task.is_valid(self.scene)
        truncated = self._steps >= self._max_episode_steps and not terminated
        return self._observe(), float(success), terminated, truncated, {"is_success": success}

    def expert_action(self) -> NDArray[np.float32]:
        """Return the expert's action in the current state, (5,) float32."""
        return self.episode_task.expert_action(self.scene).astype(np.float32)

    def render(self) -> NDArray[np.uint8]:
        """Return the first camera's image, (256, W, 3) uint8."""
        camera = next(iter(self.cameras.values()))
        return render(self.scene.client, camera.resized(RENDER_HEIGHT)).rgb

    def close(self) -> None:
        """Shut the simulator down."""
        if self._scene is not None:
            self._scene.close()
            self._scene = None

    def _observe(self) -> EnvObservation:
        arm = self.scene.arm
        position = arm.position - (*self.workspace.center, 0.0)
        observation: EnvObservation = {
            "agent_pos": np.array([*position, arm.yaw, arm.aperture], dtype=np.float32),
            "pixels": {},
        }
        for spec in self.specs:
            name, camera = spec.name, self._stated[spec.name]
            self._recent[name].append(self._render(spec))
            image = self._recent[name][0]
            observation["pixels"][name] = image.rgb
            if self.settings.depth:
                observation[_env_key(keys.depth(name))] = image.depth[None]
            if self.settings.segmentation:
                assert image.labels is not None
                labels = np.repeat(image.labels[..., None], 3, axis=-1)
                observation["pixels"][_camera_name(keys.segmentation(name))] = labels
            observation[_env_key(keys.intrinsics(name))] = camera.intrinsics.ravel().astype(np.float32)
            observation[_env_key(keys.world_from_cam(name))] = camera.world_from_cam.ravel().astype(np.float32)
        return observation

    def _render(self, spec: CameraSpec) -> CameraImages:
        camera = self.cameras[spec.name]
        with nullcontext() if spec.sees_robot else self.scene.arm.hidden():
            image = render(self.scene.client, camera, labelled=self.settings.segmentation)
        if spec.depth_noise == spec.depth_dropout == spec.flying_pixels == 0:
            return image
        depth = degrade(image.depth, spec.depth_noise, spec.depth_dropout, self._sensor_rng, spec.flying_pixels)
        return image._replace(depth=depth)


def make_env(render_mode: str | None = "rgb_array", **options: Any) -> SymviewEnv:
    """Return an environment; the entry point of `gymnasium.make`. `options` are the fields of `EnvSettings`."""
    return SymviewEnv(EnvSettings(**options), render_mode)


def checked_action(action: ArrayLike) -> NDArray[np.float64]:
    """Return an action as (5,) float64.

    Raises:
        ValueError: if it is not five finite numbers.
    """
    names = keys.ACTION_NAMES
    try:
        numbers = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"the action must be {len(names)} numbers ({', '.join(names)}): {error}") from None
    if numbers.shape != (len(names),):
        raise ValueError(f"the action must have the shape ({len(names)},) ({', '.join(names)}), got {numbers.shape}")
    wrong = [f"{name} is {number}" for name, number in zip(names, numbers, strict=True) if not np.isfinite(number)]
    if wrong:
        raise ValueError(f"the action must be finite: {', '.join(wrong)}")
    return numbers


def named_features(observation: EnvObservation) -> dict[str, NDArray[Any]]:
    """Return an observation under the keys of a LeRobot dataset. Depth (1, H, W) becomes (H, W, 1)."""
    features = {keys.STATE: observation["agent_pos"]}
    features |= {keys.rgb(name): image for name, image in observation["pixels"].items()}
    for key in observation.keys() - {"agent_pos", "pixels"}:
        value = observation[key]
        features[f"observation.{key}"] = value[0, ..., None] if value.ndim == 3 else value
    return features


def _env_key(key: str) -> str:
    """Return the observation key that LeRobot maps to `key`, by prefixing `observation.`."""
    return key.removeprefix("observation.")


def _camera_name(key: str) -> str:
    """Return the name under `pixels` that LeRobot maps to `key`, by prefixing `observation.images.`."""
    return key.removeprefix(keys.IMAGES)


def _observation_spaces(cameras: dict[str, Camera], settings: EnvSettings) -> dict[str, gymnasium.Space[Any]]:
    box = gymnasium.spaces.Box
    pixels: dict[str, gymnasium.Space[Any]] = {}
    spaces: dict[str, gymnasium.Space[Any]] = {"agent_pos": box(-np.inf, np.inf, (len(keys.STATE_NAMES),), np.float32)}
    for name, camera in cameras.items():
        shape = (camera.height, camera.width)
        pixels[name] = box(0, 255, (*shape, 3), np.uint8)
        if settings.segmentation:
            pixels[_camera_name(keys.segmentation(name))] = box(0, 255, (*shape, 3), np.uint8)
        if settings.depth:
            spaces[_env_key(keys.depth(name))] = box(0, np.inf, (1, *shape), np.float32)
        spaces[_env_key(keys.intrinsics(name))] = box(-np.inf, np.inf, (9,), np.float32)
        spaces[_env_key(keys.world_from_cam(name))] = box(-np.inf, np.inf, (16,), np.float32)
    return spaces | {"pixels": gymnasium.spaces.Dict(pixels)}
