"""The processor step that brings depth to metres and renders views while a policy runs."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

import numpy as np
import torch
from lerobot.configs.types import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import RobotObservation, TransitionKey
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry
from numpy.typing import NDArray
from torch import Tensor

from lerobot_policy_symview.inputs.camera_augmentation import augment
from lerobot_policy_symview.inputs.depth_reader import DepthReader
from lerobot_policy_symview.inputs.history import as_frames, as_history, history_length
from lerobot_policy_symview.inputs.observed_camera import ObservedCamera
from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_calibration, parse_workspace
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.gripper_state import poses_from_states
from lerobot_symview.geometry.units import METRES, parse_unit
from lerobot_symview.geometry.visibility import LEAST_VISIBLE, check_camera, detail
from lerobot_symview.views import Frame, View, ViewSpec, make_views, other_cameras

if TYPE_CHECKING:
    from lerobot_symview.views.torch_backend import FrameBatch

logger = logging.getLogger(__name__)

Renderer = Callable[[Frame], dict[str, NDArray[Any]]]
_REMEMBERING: WeakValueDictionary[int, ViewsProcessorStep] = WeakValueDictionary()


@dataclass
@ProcessorStepRegistry.register(name="symview_views")
class ViewsProcessorStep(ObservationProcessorStep):
    """Brings depth to float metres and adds top-down views of a camera; views that are present are kept unchanged.

    A view merges further cameras by its option `cameras`; it is made without those whose image an observation lacks. A
    view with memory takes successive observations for the successive frames of an episode, until `reset`.

    Colour is float in [0, 1] or uint8. Calibration is flat, (9,) and (16,), or square, (3, 3) and (4, 4), for all
    frames or for each, and may have a lens, (9,). An observation without it, such as a real robot's, uses
    `calibration`.

    Args:
        views: the views to add, by name or as mappings with name and options (`lerobot_symview.views.ViewSpec`).
        camera: the camera from which they are made.
        workspace: constructor arguments of `Workspace`; by default the calibration's, or the default one.
        calibration: content of a calibration file (`lerobot_symview.calibration`), or nothing.
        gripper: indices of the gripper's x, y, z, yaw and aperture in `observation.state`, null for a yaw or aperture
            that it lacks; none where the gripper's state is unknown: then nothing is clipped and no gripper image is
            drawn.
        depth_units: feature -> `m`, `mm` or metres per unit, the unit in which depth and height images arrive. It is
            not stored in checkpoints: LeRobot's loader delivers millimetres where an environment delivers metres. Units
            that are not given are the calibration's; else, for the cameras of views, the one that shows the table at
            z = 0; else they are inferred from the values. What is inferred is logged.
        augmentation: strength of random errors of the cameras, for observations with an action, whose views are then
            made anew (`lerobot_policy_symview.inputs.camera_augmentation`).
        require_views: raise an error for a black view of an observation without an action; by default, warn once.

    Raises (from `observation`):
        CalibrationError: if the first observation contradicts the calibration: the camera is below the table, too far
            away for the workspace, or its depth shows the table elsewhere or nothing; with `require_views`, if a view
            is black.
    """

    views: list[Any] = field(default_factory=list)
    camera: str = "side"
    workspace: dict[str, Any] = field(default_factory=dict)
    calibration: dict[str, Any] = field(default_factory=dict)
    gripper: list[int | None] = field(default_factory=lambda: list(range(len(keys.STATE_NAMES))))
    depth_units: dict[str, Any] = field(default_factory=dict)
    augmentation: float = 0.0
    require_views: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.views, list | tuple):
            raise ValueError(f"views must be a list of names or mappings, got {self.views!r}")
        specs = [ViewSpec.parse(view) for view in self.views]
        self.views = [spec.plain() for spec in specs]
        views = make_views(specs) if specs else {}
        self._views = views if self.gripper else {name: view.without_gripper() for name, view in views.items()}
        calibration = parse_calibration(self.calibration) if self.calibration else None
        fixed = {self.camera: calibration.camera(self.camera), **calibration.cameras} if calibration else {}
        names = [self.camera, *other_cameras(views.values(), self.camera)]
        self._observed = {name: ObservedCamera(name, fixed.get(name)) for name in names}
        default = calibration.workspace if calibration and not self.workspace else None
        self._workspace = default or parse_workspace(self.workspace)
        for name, observed in self._observed.items():
            if observed.fixed is not None:
                check_camera(name, observed.fixed, self._workspace, minimum=LEAST_VISIBLE)
        calibrated = calibration.depth_units if calibration else {}
        units = {keys.depth(name): unit for name, unit in calibrated.items() if name in self._observed}
        units |= {key: parse_unit(unit) for key, unit in self.depth_units.items()}
        self._depth = DepthReader(units, self._observed, self._workspace)
        self._substitutes: set[str] = set()
        self._absent: set[str] = set()
        self._black: set[str] = set()
        self._episodes: dict[str, list[Renderer]] = {}
        if any(view.memory for view in self._views.values()):
            _REMEMBERING[id(self)] = self
        self._checked = False

    def observation(self, observation: RobotObservation) -> RobotObservation:
        """Return the observation with depth in metres and the views it lacks, float32 (B, C, size, size).

        Observations with a history (B, T, ...) get views (B, T, C, size, size).
        """
        length = history_length(observation)
        if length is not None:
            return as_history(self._with_views(as_frames(observation), length), length)
        return self._with_views(observation)

    def _with_views(self, observation: RobotObservation, history: int = 1) -> RobotObservation:
        """Return frames (T B, ...) with depth in metres and views; T, the `history`, are of the same camera."""
        observation = self._depth.in_metres(self._own_names(observation))
        is_augmented = self.augmentation > 0 and is_training(self)
        if is_augmented:
            observation = {key: values for key, values in observation.items() if key not in self._made}
        missing = {
            name: view
            for name, view in self._views.items()
            if not all(keys.view(self.camera, output) in observation for output in view.outputs)
        }
        if missing and not self._checked:
            self._check(self._batches(observation, missing))
            self._checked = True
        if is_augmented:
            observation = augment(observation, self._observed.values(), self.augmentation, history)
        if not missing:
            return observation
        batches = self._batches(observation, missing)
        for name, view in missing.items():
            rendered = self._rendered(name, view, self._merged(view, batches))
            if not is_training(self):
                self._report_black(name, rendered[next(iter(view.outputs))])
            for output, images in rendered.items():
                made = images.float() / 255 if images.dtype == torch.uint8 else images[:, None]
                observation.setdefault(keys.view(self.camera, output), made)
        return observation

    def reset(self) -> None:
        """Start an episode: views with memory forget the frames of the last one."""
        self._episodes.clear()

    def get_config(self) -> dict[str, Any]:
        """Return the constructor's arguments that a checkpoint stores as JSON."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "depth_units"}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Keep the declared features unchanged: the policy names what it needs."""
        return features

    @property
    def _made(self) -> list[str]:
        """The features of the views."""
        return [keys.view(self.camera, output) for view in self._views.values() for output in view.outputs]

    def _own_names(self, observation: RobotObservation) -> RobotObservation:
        """Return the observation with the names of `camera`, where those of another camera were not all renamed."""
        source = [keys.rgb(self.camera)]
        if any(view.needs_depth for view in self._views.values()):
            source.append(keys.depth(self.camera))
        own = self._observed[self.camera]
        if own.fixed is None:
            source += own.matrices
        others = keys.substitutes(observation, self.camera, self._made, source) if self._made else []
        others = [name for name in others if name not in self._observed]
        if len(others) != 1:
            return observation
        if others[0] not in self._substitutes:
            self._substitutes.add(others[0])
            logger.info("the camera %r takes the place of %r", others[0], self.camera)
        features = [keys.rgb(self.camera), keys.depth(self.camera), *keys.calibration(self.camera), *self._made]
        return keys.as_camera(observation, self.camera, others[0], features)

    def _check(self, batches: dict[str, FrameBatch]) -> None:
        """Raise a CalibrationError if the first frame contradicts a calibration; log detail and how cameras agree."""
        from lerobot_symview.calibration.agreement import report_agreement
        from lerobot_symview.calibration.table_plane import check_table, has_depth

        sizes = {name: view.size for name, view in self._views.items()}
        depths: dict[str, NDArray[np.floating]] = {}
        for name, batch in batches.items():
            camera = batch.cameras[0]
            check_camera(name, camera, self._workspace, minimum=LEAST_VISIBLE)
            logger.info("%s", detail(name, camera, self._workspace, sizes))
            if batch.depth is None:
                continue
            key, depths[name] = keys.depth(name), batch.depth[0].cpu().numpy()
            if not has_depth(depths[name], camera, self._workspace):
                problem = f"{key} has no valid pixel in the workspace: check the camera, its pose and its lens"
                if len(batches) == 1:
                    raise CalibrationError(problem)
                logger.warning("%s", problem)
                continue
            try:
                check_table(depths[name], camera, self._workspace, self._depth.units.get(key, METRES))
            except CalibrationError as error:
                raise CalibrationError(f"{key}: {error}") from None
        if len(depths) > 1:
            gripper = batches[self.camera].gripper if self.camera in batches else None
            ceiling = None if gripper is None else float(gripper[0, 2])
            cameras = {name: batch.cameras[0] for name, batch in batches.items()}
            report_agreement(depths, cameras, self._workspace, ceiling)

    def _report_black(self, name: str, images: Tensor) -> None:
        """Raise a CalibrationError, or warn once, if a view is black in some frame."""
        if bool((images != 0).flatten(1).any(1).all()):
            return
        problem = (
            f"the view {name!r} of camera {self.camera!r} is black: the camera delivers no image or depth of the "
            "workspace, or something hides all of it"
        )
        if self.require_views:
            raise CalibrationError(problem)
        if name not in self._black:
            self._black.add(name)
            logger.warning("%s", problem)

    def _batches(self, observation: RobotObservation, views: dict[str, View]) -> dict[str, FrameBatch]:
        """Return the images of the cameras that views need and the observation has, by name."""
        from lerobot_symview.views.torch_backend import FrameBatch  # numba: too slow for a plugin's import

        gripper = None
        needed = []
        if self.gripper and any(view.uses_gripper for view in views.values()):
            needed.append(keys.STATE)
            if keys.STATE in observation:
                gripper = poses_from_states(observation[keys.STATE].detach(), self.gripper)
        batches: dict[str, FrameBatch] = {}
        for name, camera in self._observed.items():
            merging = [view for view in views.values() if name == self.camera or name in view.cameras]
            depth = any(view.needs_depth for view in merging)
            if not merging or self._is_absent(name, observation, list(views.values())):
                continue
            missing = [key for key in needed + camera.needed(observation, depth=depth) if key not in observation]
            if missing:
                raise KeyError(
                    f"the views {list(views)} need {missing}, the observation has {sorted(observation)}: name its "
                    "camera with --policy.camera, or rename its image with --rename_map"
                )
            cameras = camera.cameras(observation)
            aligned = camera.aligned_depth(observation, cameras) if depth else None
            batches[name] = FrameBatch(camera.colors(observation), aligned, cameras, self._workspace, gripper)
        return batches

    def _is_absent(self, name: str, observation: RobotObservation, views: list[View]) -> bool:
        """Whether a camera delivers nothing now, but another one with which all views merge it does."""
        if keys.rgb(name) in observation:
            return False
        merged = [{self.camera, *view.cameras} for view in views]
        present = [other for other in self._observed if keys.rgb(other) in observation]
        is_absent = all(any(other in cameras for other in present) for cameras in merged)
        if is_absent and name not in self._absent:
            self._absent.add(name)
            logger.warning("the observation has no %s: views are made without it", keys.rgb(name))
        return is_absent

    def _merged(self, view: View, batches: dict[str, FrameBatch]) -> FrameBatch:
        """Return the batch of a view: that of its first camera, with those of the cameras that it merges."""
        first, *others = [name for name in (self.camera, *other_cameras([view], self.camera)) if name in batches]
        return replace(batches[first], others={name: batches[name] for name in others})

    def _rendered(self, name: str, view: View, batch: FrameBatch) -> dict[str, Tensor]:
        """Return each output for all frames, on their device: together by CUDA, by the compiled kernels elsewhere."""
        from lerobot_symview.views.torch_backend import can_batch, render_batch

        device = batch.rgb.device
        if device.type == "cuda" and can_batch(view):  # Apple's GPUs have no float64, which bit-identical images need
            return render_batch(view, batch)
        frames = _frames(batch)
        if len(self._episodes.get(name, ())) != len(frames):
            self._episodes[name] = [view.start_episode() for _ in frames]
        images = [render(frame) for render, frame in zip(self._episodes[name], frames, strict=True)]
        stacked = {output: torch.from_numpy(np.stack([image[output] for image in images])) for output in images[0]}
        channels_first = {
            output: image.permute(0, 3, 1, 2) if image.ndim == 4 else image for output, image in stacked.items()
        }
        return {output: image.to(device) for output, image in channels_first.items()}


def is_training(step: ObservationProcessorStep) -> bool:
    """Whether a step's observations have actions, as those of a dataset do."""
    transition = getattr(step, "_current_transition", None)
    return transition is not None and transition.get(TransitionKey.ACTION) is not None


def start_episodes() -> None:
    """Reset every live step whose views have memory.

    LeRobot's evaluation resets the policy at the start of its episodes, and not the processors.
    """
    for step in list(_REMEMBERING.values()):
        step.reset()


def _frames(batch: FrameBatch) -> list[Frame]:
    rgb = batch.rgb.permute(0, 2, 3, 1).contiguous().cpu().numpy()
    depth, gripper = (None if one is None else one.cpu().numpy() for one in (batch.depth, batch.gripper))
    others = {name: _frames(other) for name, other in batch.others.items()}
    return [
        Frame(
            rgb[i],
            None if depth is None else depth[i],
            camera,
            batch.workspace,
            None if gripper is None else gripper[i],
            {name: frames[i] for name, frames in others.items()},
        )
        for i, camera in enumerate(batch.cameras)
    ]
