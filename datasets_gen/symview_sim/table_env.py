"""What the environments of every simulator have in common: states, actions, cameras, and an expert."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.placement import CameraSpec
from symview_sim.camera_rig import CameraImages, CameraRig, EnvObservation
from symview_sim.lens import pinhole_camera, through_lens
from symview_sim.settings import WorldSettings

RENDER_HEIGHT = 256  # pixels


class TableEnv(gymnasium.Env[EnvObservation, NDArray[np.float32]]):
    """A table seen by freely placed RGBD cameras, and a gripper over it.

    Observation: `pixels[<camera>]` uint8 (H, W, 3); `images.<camera>_depth` float32 (1, H, W), metres along the optical
    axis, 0 = invalid; as the calibration states them, `camera.<camera>.intrinsics` float32 (9,), pixels, row-major,
    `camera.<camera>.world_from_cam` float32 (16,), row-major, and of a lens `camera.<camera>.distortion` float32 (9,),
    as `Lens.stored` returns; `agent_pos` float32, the gripper's state, with x and y relative to the workspace's centre.
    With `segmentation`, `pixels[<camera>_segmentation]` uint8 (H, W, 3), the same label in each channel.

    Args:
        settings: task, workspace, cameras and limits.
        instruction: the task in words.
        action_low: lower limits of an action.
        action_high: upper limits of an action.
        render_mode: `rgb_array` (or None); `render()` returns the first camera's image.

    Raises:
        CalibrationError: if a camera's image contains less than 60 % of the working volume, or its lens is too wide to
            be rendered.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012  gymnasium's own form

    def __init__(
        self,
        settings: WorldSettings,
        instruction: str,
        action_low: NDArray[np.float32],
        action_high: NDArray[np.float32],
        render_mode: str | None = "rgb_array",
    ):
        self.settings, self.workspace = settings, settings.workspace
        self.task, self.task_description = settings.task, instruction
        self.metadata = self.metadata | {"render_fps": settings.actions_per_second}
        self.render_mode = render_mode
        self._max_episode_steps = settings.episode_steps  # LeRobot reads it under this name
        self.specs = settings.all_cameras
        shown = {"depth": settings.depth, "segmentation": settings.has_labels}
        self._rig = CameraRig(self.specs, self.workspace, self._see, self._place, **shown)
        for camera in self._rig.cameras.values():
            pinhole_camera(camera)  # raises now for a lens that is too wide, not in the first reset
        self._action_low, self._action_high = action_low, action_high
        self.action_space = gymnasium.spaces.Box(action_low, action_high)
        state = gymnasium.spaces.Box(-np.inf, np.inf, (len(settings.state_names),), np.float32)
        self.observation_space = gymnasium.spaces.Dict({"agent_pos": state} | self._rig.spaces())

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras of the present episode, by name."""
        return self._rig.cameras

    @abstractmethod
    def step(self, action: NDArray[np.floating]) -> tuple[EnvObservation, float, bool, bool, dict[str, Any]]:
        """Move the gripper by an action, clamped to the action space."""

    @abstractmethod
    def expert_action(self) -> NDArray[np.float32]:
        """Return the expert's action in the current state."""

    @property
    def episode_style(self) -> dict[str, Any]:
        """How the episode is demonstrated, as JSON values; {} if the state determines the expert's actions."""
        return {}

    def render(self) -> NDArray[np.uint8]:
        """Return the first camera's image, (256, W, 3) uint8."""
        spec = self.specs[0]
        return self._see(spec, self.cameras[spec.name].resized(RENDER_HEIGHT)).rgb

    def _see(self, spec: CameraSpec, camera: Camera) -> CameraImages:
        """Return what a camera sees now, through its lens if it has one."""
        return through_lens(partial(self._draw, spec), camera)

    @abstractmethod
    def _draw(self, spec: CameraSpec, camera: Camera) -> CameraImages:
        """Return what a pinhole camera sees now."""

    def _place(self, spec: CameraSpec, rng: np.random.Generator) -> Camera:
        """Return the camera of an episode."""
        return spec.place(self.workspace, rng)

    def _clipped(self, action: ArrayLike) -> NDArray[np.float64]:
        """Return an action within its limits.

        Raises:
            ValueError: if it is not as many finite numbers as an action has.
        """
        checked = checked_action(action, self.settings.action_names)
        return np.clip(checked, self._action_low, self._action_high)

    def _observe(self, state: Sequence[float]) -> EnvObservation:
        """Return the observation in a state of the gripper, with x and y relative to the workspace's centre."""
        return {"agent_pos": np.array(state, dtype=np.float32)} | self._rig.observe()


def checked_action(action: ArrayLike, names: Sequence[str]) -> NDArray[np.float64]:
    """Return an action as float64.

    Args:
        action: the action.
        names: of its dimensions.

    Raises:
        ValueError: if it is not as many finite numbers as `names`.
    """
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
