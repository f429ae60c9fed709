"""The cameras of an environment: where they stand in an episode, what they see, and what their calibration states."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from lerobot_symview import keys
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.lens import STORED
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.geometry.workspace import Workspace
from symview_sim.depth_sensor import degrade

EnvObservation = dict[str, Any]


class CameraImages(NamedTuple):
    """What one camera sees.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32, metres along the optical axis, 0 where nothing is seen.
        labels: (H, W) uint8, 0 where the table or nothing is seen, else the body's place in the order of loading; None
            unless they were asked for.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    labels: NDArray[np.uint8] | None = None


Draw = Callable[[CameraSpec, Camera], CameraImages]
Place = Callable[[CameraSpec, np.random.Generator], Camera]


class CameraRig:
    """The cameras of an environment.

    Args:
        specs: the cameras.
        workspace: the working volume that they must see.
        draw: renders what a camera sees.
        place: places a camera for an episode.
        depth: whether observations have depth.
        segmentation: whether observations have segmentation labels.

    Raises:
        CalibrationError: if a camera's image contains less than 60 % of the working volume.
    """

    def __init__(
        self,
        specs: Sequence[CameraSpec],
        workspace: Workspace,
        draw: Draw,
        place: Place,
        *,
        depth: bool = True,
        segmentation: bool = False,
    ):
        self._specs, self._draw, self._place = specs, draw, place
        self._depth, self._segmentation = depth, segmentation
        self.cameras = {spec.name: spec.place(workspace) for spec in specs}
        self._stated: dict[str, Camera] = {}  # the cameras as their calibration, which may be wrong, states them
        self._recent: dict[str, deque[CameraImages]] = {}
        self._placed = False

    def start_episode(self, rng: np.random.Generator) -> None:
        """Place the cameras for an episode.

        Args:
            rng: the environment's. It is not advanced: cameras do not change the physics.
        """
        pose_rng, self._sensor_rng = rng.spawn(2)
        (calibration_rng,) = pose_rng.spawn(1)
        for spec in self._specs:
            if spec.varies or not self._placed:
                self.cameras[spec.name] = self._place(spec, pose_rng)
            camera = self.cameras[spec.name]
            stated = spec.miscalibration.stated(camera, calibration_rng) if spec.miscalibration else camera
            self._stated[spec.name] = stated if spec.distortion_known else replace(stated, lens=None)
            self._recent[spec.name] = deque(maxlen=spec.delay + 1)
        self._placed = True

    def observe(self) -> EnvObservation:
        """Return what the cameras see, and their calibration, under the keys of `spaces`."""
        observation: EnvObservation = {"pixels": {}}
        for spec in self._specs:
            name, camera = spec.name, self._stated[spec.name]
            self._recent[name].append(self._sensed(spec))
            image = self._recent[name][0]
            observation["pixels"][name] = image.rgb
            if self._depth:
                observation[_env_key(keys.depth(name))] = image.depth[None]
            if self._segmentation:
                assert image.labels is not None
                labels = np.repeat(image.labels[..., None], 3, axis=-1)
                observation["pixels"][_camera_name(keys.segmentation(name))] = labels
            observation[_env_key(keys.intrinsics(name))] = camera.intrinsics.ravel().astype(np.float32)
            observation[_env_key(keys.world_from_cam(name))] = camera.world_from_cam.ravel().astype(np.float32)
            if camera.lens is not None:
                observation[_env_key(keys.distortion(name))] = camera.lens.stored().astype(np.float32)
        return observation

    def spaces(self) -> dict[str, gymnasium.Space[Any]]:
        """Return the spaces of the observations."""
        box = gymnasium.spaces.Box
        pixels: dict[str, gymnasium.Space[Any]] = {}
        spaces: dict[str, gymnasium.Space[Any]] = {}
        for spec in self._specs:
            name, camera = spec.name, self.cameras[spec.name]
            shape = (camera.height, camera.width)
            pixels[name] = box(0, 255, (*shape, 3), np.uint8)
            if self._segmentation:
                pixels[_camera_name(keys.segmentation(name))] = box(0, 255, (*shape, 3), np.uint8)
            if self._depth:
                spaces[_env_key(keys.depth(name))] = box(0, np.inf, (1, *shape), np.float32)
            spaces[_env_key(keys.intrinsics(name))] = box(-np.inf, np.inf, (9,), np.float32)
            spaces[_env_key(keys.world_from_cam(name))] = box(-np.inf, np.inf, (16,), np.float32)
            if spec.states_lens:
                spaces[_env_key(keys.distortion(name))] = box(-np.inf, np.inf, (STORED,), np.float32)
        return spaces | {"pixels": gymnasium.spaces.Dict(pixels)}

    def _sensed(self, spec: CameraSpec) -> CameraImages:
        image = self._draw(spec, self.cameras[spec.name])
        if spec.depth_noise == spec.depth_dropout == spec.flying_pixels == 0:
            return image
        depth = degrade(image.depth, spec.depth_noise, spec.depth_dropout, self._sensor_rng, spec.flying_pixels)
        return image._replace(depth=depth)


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
