"""The processor step that brings depth to metres and renders views while a policy runs."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.configs.types import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import RobotObservation
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry
from numpy.typing import NDArray
from torch import Tensor

from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_calibration, parse_workspace
from lerobot_symview.datasets.features import check_depth_size, declared_unit
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera, aligned_depth, stored_camera
from lerobot_symview.geometry.lens import STORED
from lerobot_symview.geometry.units import (
    ABOVE_MINIMUM,
    METRES,
    MILLIMETRES,
    VIDEO_MINIMUM,
    infer_depth_unit,
    infer_height_unit,
    parse_unit,
    unit_name,
    units_per_metre,
)
from lerobot_symview.geometry.visibility import LEAST_VISIBLE, check_camera
from lerobot_symview.views import Frame, View, ViewSpec, make_views

if TYPE_CHECKING:
    from lerobot_symview.views.torch_backend import FrameBatch

logger = logging.getLogger(__name__)

IN_METRES = "observation.depth_in_metres"  # marks observations whose depth a step has brought to metres


@dataclass
@ProcessorStepRegistry.register(name="symview_views")
class ViewsProcessorStep(ObservationProcessorStep):
    """Brings depth to float metres and adds top-down views of one camera; views that are present are kept unchanged.

    Colour is float in [0, 1] or uint8. Calibration is flat, (9,) and (16,), or square, (3, 3) and (4, 4), for all
    frames or for each, and may have a lens, (9,). An observation without it, such as a real robot's, uses
    `calibration`.

    Args:
        views: the views to add, by name or as mappings with name and options (`lerobot_symview.views.ViewSpec`).
        camera: the camera from which they are made.
        workspace: constructor arguments of `Workspace`; by default the calibration's, or the default one.
        calibration: content of a calibration file (`lerobot_symview.calibration`), or nothing.
        gripper: indices of the gripper's x, y, z, yaw and aperture in `observation.state`; none where the gripper's
            state is unknown: then nothing is clipped and no gripper image is drawn.
        depth_units: feature -> `m`, `mm` or metres per unit, the unit in which depth and height images arrive. It is
            not stored in checkpoints: LeRobot's loader delivers millimetres where an environment delivers metres. Units
            that are not given are the calibration's; else, for `camera`, the one that shows the table at z = 0; else
            they are inferred from the values. What is inferred is logged.

    Raises (from `observation`):
        CalibrationError: if the first observation contradicts the calibration: the camera is below the table, too far
            away for the workspace, or its depth shows the table elsewhere or nothing.
    """

    views: list[Any] = field(default_factory=list)
    camera: str = "side"
    workspace: dict[str, Any] = field(default_factory=dict)
    calibration: dict[str, Any] = field(default_factory=dict)
    gripper: list[int] = field(default_factory=lambda: list(range(len(keys.STATE_NAMES))))
    depth_units: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.views, list | tuple):
            raise ValueError(f"views must be a list of names or mappings, got {self.views!r}")
        specs = [ViewSpec.parse(view) for view in self.views]
        self.views = [spec.plain() for spec in specs]
        views = make_views(specs) if specs else {}
        self._views = views if self.gripper else {name: view.without_gripper() for name, view in views.items()}
        calibration = parse_calibration(self.calibration) if self.calibration else None
        self._fixed_camera = calibration.camera(self.camera) if calibration else None
        default = calibration.workspace if calibration and not self.workspace else None
        self._workspace = default or parse_workspace(self.workspace)
        if self._fixed_camera is not None:
            check_camera(self.camera, self._fixed_camera, self._workspace, minimum=LEAST_VISIBLE)
        calibrated = calibration.depth_units.get(self.camera) if calibration else None
        self._units = {} if calibrated is None else {keys.depth(self.camera): calibrated}
        self._units |= {key: parse_unit(unit) for key, unit in self.depth_units.items()}
        self._table_units: dict[tuple[str, torch.dtype], float] = {}
        self._read_units: dict[str, float] = {}
        self._logged: set[tuple[str, float]] = set()
        self._substitutes: set[str] = set()
        self._checked = False

    def observation(self, observation: RobotObservation) -> RobotObservation:
        """Return the observation with depth in metres and the views it lacks, float32 (B, C, size, size)."""
        observation = self._in_metres(self._own_names(observation))
        missing = {
            name: view
            for name, view in self._views.items()
            if not all(keys.view(self.camera, output) in observation for output in view.outputs)
        }
        if not missing:
            return observation
        needs_depth = any(view.needs_depth for view in missing.values())
        uses_gripper = any(view.uses_gripper for view in missing.values())
        batch = self._batch(observation, list(missing), needs_depth, uses_gripper)
        if not self._checked:
            self._check(batch)
            self._checked = True
        for view in missing.values():
            for output, images in _render(view, batch).items():
                made = images.float() / 255 if images.dtype == torch.uint8 else images[:, None]
                observation.setdefault(keys.view(self.camera, output), made)
        return observation

    def get_config(self) -> dict[str, Any]:
        """Return the constructor's arguments that a checkpoint stores as JSON."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "depth_units"}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Keep the declared features unchanged: the policy names what it needs."""
        return features

    def _own_names(self, observation: RobotObservation) -> RobotObservation:
        """Return the observation with the names of `camera`, where those of another camera were not all renamed."""
        made = [keys.view(self.camera, output) for view in self._views.values() for output in view.outputs]
        source = [keys.rgb(self.camera)]
        if any(view.needs_depth for view in self._views.values()):
            source.append(keys.depth(self.camera))
        if self._fixed_camera is None:
            source += self._matrix_shapes
        others = keys.substitutes(observation, self.camera, made, source) if made else []
        if len(others) != 1:
            return observation
        if others[0] not in self._substitutes:
            self._substitutes.add(others[0])
            logger.info("the camera %r takes the place of %r", others[0], self.camera)
        features = [keys.rgb(self.camera), keys.depth(self.camera), *keys.calibration(self.camera), *made]
        return keys.as_camera(observation, self.camera, others[0], features)

    def _in_metres(self, observation: RobotObservation) -> RobotObservation:
        """Convert all depth and height images to float metres, once per observation."""
        if IN_METRES in observation:
            return observation
        images = {
            key: values.detach()
            for key, values in observation.items()
            if key.startswith(keys.IMAGES) and key.endswith(("_depth", "_height"))
        }
        if not images:
            return observation
        self._read_units = {key: self._unit(key, values, observation) for key, values in images.items()}
        converted = {key: _metres(values, self._read_units[key]) for key, values in images.items()}
        converted |= {key: _without_minimum(depth) for key, depth in converted.items() if key.endswith("_depth")}
        return {**observation, **converted, IN_METRES: torch.ones(())}

    def _unit(self, key: str, values: Tensor, observation: RobotObservation) -> float:
        unit = self._units.get(key) or self._table_units.get((key, values.dtype))
        if unit is not None:
            return unit
        if key == keys.depth(self.camera) and (unit := self._unit_by_table(values, observation)) is not None:
            self._table_units[key, values.dtype] = unit
            logger.info("%s declares no unit: the table at z = 0 shows %s", key, unit_name(unit))
            return unit
        unit = (infer_height_unit if key.endswith("_height") else infer_depth_unit)(values)
        if values.is_floating_point() and (key, unit) not in self._logged:
            self._logged.add((key, unit))
            logger.info("%s declares no unit: its values are taken to be %s", key, unit_name(unit))
        return unit

    def _unit_by_table(self, depth: Tensor, observation: RobotObservation) -> float | None:
        from lerobot_symview.calibration.table_plane import likely_depth_unit

        color = observation.get(keys.rgb(self.camera))
        if self._missing_matrices(observation) or not depth.numel() or color is None:
            return None
        camera = self._cameras(observation, len(depth), *color.shape[-2:])[0]
        if camera.depth_sensor is None and depth.shape[-2:] != color.shape[-2:]:
            return None  # `_batch` rejects it
        height, width = depth.shape[-2:]
        image = depth[0].reshape(height, width).cpu().numpy()
        return likely_depth_unit(image, camera.depth_camera(height, width), self._workspace)

    def _check(self, batch: FrameBatch) -> None:
        """Raise a CalibrationError if the first frame contradicts the calibration."""
        from lerobot_symview.calibration.table_plane import check_table, has_depth

        camera = batch.cameras[0]
        check_camera(self.camera, camera, self._workspace, minimum=LEAST_VISIBLE)
        if batch.depth is None:
            return
        key, depth = keys.depth(self.camera), batch.depth[0].cpu().numpy()
        if not has_depth(depth, camera, self._workspace):
            raise CalibrationError(
                f"{key} has no valid pixel in the workspace: check the camera, its pose and its lens"
            )
        try:
            check_table(depth, camera, self._workspace, self._read_units.get(key, METRES))
        except CalibrationError as error:
            raise CalibrationError(f"{key}: {error}") from None

    def _batch(
        self, observation: RobotObservation, views: list[str], needs_depth: bool, uses_gripper: bool
    ) -> FrameBatch:
        from lerobot_symview.views.torch_backend import FrameBatch  # numba: too slow for a plugin's import

        color, depth = keys.rgb(self.camera), keys.depth(self.camera)
        uses_gripper = uses_gripper and bool(self.gripper)
        needed = [color] + ([depth] if needs_depth else []) + ([keys.STATE] if uses_gripper else [])
        missing = [key for key in needed if key not in observation] + self._missing_matrices(observation)
        if missing:
            raise KeyError(
                f"the views {views} need {missing}, the observation has {sorted(observation)}: name its camera with "
                "--policy.camera, or rename its image with --rename_map"
            )
        rgb = observation[color].detach()
        if rgb.dtype != torch.uint8:
            rgb = (rgb * 255).round().to(torch.uint8)
        height, width = rgb.shape[2:]
        cameras = self._cameras(observation, len(rgb), height, width)
        return FrameBatch(
            rgb,
            self._aligned(observation[depth][:, 0], cameras) if needs_depth else None,
            cameras,
            self._workspace,
            observation[keys.STATE].detach()[:, self.gripper] if uses_gripper else None,
        )

    def _aligned(self, depth: Tensor, cameras: list[Camera]) -> Tensor:
        """Return depth (B, H, W) in the pixels of the colour images; `depth` is that of the sensors, metres."""
        if all(camera.depth_sensor is None for camera in cameras):
            check_depth_size(self.camera, depth.shape[1:], (cameras[0].height, cameras[0].width))
            return depth
        images = [aligned_depth(image, camera) for image, camera in zip(depth.cpu().numpy(), cameras, strict=True)]
        return torch.from_numpy(np.stack(images)).to(depth.device)

    def _missing_matrices(self, observation: RobotObservation) -> list[str]:
        """Return the calibration's keys that the observation lacks, where the step has no calibration of its own."""
        return [] if self._fixed_camera is not None else [key for key in self._matrix_shapes if key not in observation]

    @property
    def _matrix_shapes(self) -> dict[str, tuple[int, ...]]:
        """Keys of an observation's calibration -> shape of the matrix."""
        return {keys.intrinsics(self.camera): (3, 3), keys.world_from_cam(self.camera): (4, 4)}

    def _cameras(self, observation: RobotObservation, count: int, height: int, width: int) -> list[Camera]:
        """Return the camera of each of `count` frames: the observation's, else the step's own."""
        if all(key in observation for key in self._matrix_shapes):
            shapes = self._matrix_shapes | {
                keys.distortion(self.camera): (STORED,),
                keys.depth_intrinsics(self.camera): (3, 3),
                keys.color_from_depth(self.camera): (4, 4),
            }
            stored = keys.calibration(self.camera, observation)
            names = [keys.parameter(key) for key in stored]
            columns = (_numbers(key, observation[key], shapes[key], count) for key in stored)
            return [
                stored_camera(height=height, width=width, **dict(zip(names, numbers, strict=True)))
                for numbers in zip(*columns, strict=True)
            ]
        camera = self._fixed_camera
        assert camera is not None
        if (height, width) != (camera.height, camera.width):
            raise CalibrationError(
                f"camera {self.camera!r} is calibrated for {camera.height} x {camera.width} pixels, "
                f"the observation has {height} x {width}"
            )
        return [camera] * count


def delivered_units(meta: Any) -> dict[str, float]:
    """Return the metres per unit in which LeRobot's loader delivers each depth feature that declares its unit.

    The loader converts to `--dataset.depth_output_unit`, which it does not pass on; it rescales the statistics to the
    same unit, so these tell (`LeRobotDatasetMetadata.rescale_depth_stats`).

    Args:
        meta: of the `LeRobotDataset`.
    """
    from lerobot.datasets.io_utils import load_stats

    stored_stats = load_stats(meta.root) or {}
    units: dict[str, float] = {}
    for key in meta.depth_keys:
        unit = declared_unit(meta.features[key])
        if unit is None or key not in stored_stats or key not in (meta.stats or {}):
            continue
        same = np.allclose(meta.stats[key]["max"], stored_stats[key]["max"])
        units[key] = unit if same else (METRES if unit == MILLIMETRES else MILLIMETRES)
    return units


def _metres(depth: Tensor, unit: float) -> Tensor:
    depth = depth if depth.is_floating_point() else depth.float()
    # By a tensor: by a plain number a GPU may multiply with the rounded reciprocal, which rounds differently.
    return depth if unit == METRES else depth / depth.new_full((), units_per_metre(unit))


def _without_minimum(depth: Tensor) -> Tensor:
    """Return depth in metres with 0 for the pixels that LeRobot's depth videos clip to their minimum."""
    is_lost = (depth - VIDEO_MINIMUM).abs() <= VIDEO_MINIMUM * (ABOVE_MINIMUM - 1)
    return torch.where(is_lost, torch.zeros_like(depth), depth)


def _numbers(key: str, numbers: Tensor, shape: tuple[int, ...], count: int) -> NDArray[np.floating]:
    """Return (count, N): numbers for each frame, or for all, which LeRobot leaves without a batch axis."""
    flat = (math.prod(shape),)
    shapes = list(dict.fromkeys([flat, shape, (count, *flat), (count, *shape)]))
    if tuple(numbers.shape) not in shapes:
        raise CalibrationError(f"{key} has shape {tuple(numbers.shape)}, expected one of {shapes}")
    return np.broadcast_to(numbers.detach().cpu().numpy().reshape(-1, *flat), (count, *flat))


def _render(view: View, batch: FrameBatch) -> dict[str, Tensor]:
    """Return each output for all frames, on their device: together by CUDA, by the compiled kernels elsewhere."""
    from lerobot_symview.views.torch_backend import can_batch, render_batch

    device = batch.rgb.device
    if device.type == "cuda" and can_batch(view):  # Apple's GPUs have no float64, which bit-identical images need
        return render_batch(view, batch)
    rgb = batch.rgb.permute(0, 2, 3, 1).contiguous().cpu().numpy()
    depth, gripper = (None if one is None else one.cpu().numpy() for one in (batch.depth, batch.gripper))
    images = [
        view.render(
            Frame(
                rgb[i],
                None if depth is None else depth[i],
                camera,
                batch.workspace,
                None if gripper is None else gripper[i],
            )
        )
        for i, camera in enumerate(batch.cameras)
    ]
    stacked = {output: torch.from_numpy(np.stack([image[output] for image in images])) for output in images[0]}
    channels_first = {
        output: image.permute(0, 3, 1, 2) if image.ndim == 4 else image for output, image in stacked.items()
    }
    return {output: image.to(device) for output, image in channels_first.items()}
