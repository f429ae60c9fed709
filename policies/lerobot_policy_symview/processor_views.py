"""The processor step that computes views of an observation while a policy runs."""

from __future__ import annotations

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
from lerobot_symview.geometry.camera import MILLIMETRES_PER_METRE, CalibrationError, Camera, stored_camera
from lerobot_symview.views import Frame, View, make_view

if TYPE_CHECKING:
    from lerobot_symview.views.torch_backend import FrameBatch

METRES_AT_MOST = 10.0  # nothing on a table is as far or as high, and nothing that is seen is within as many millimetres


def metres_of_depth(depth: Tensor) -> Tensor:
    """Return depth in metres, whatever unit LeRobot delivered it in.

    `lerobot-train` converts a dataset's metres to millimetres unless told otherwise and does not say so in the batch,
    while environments yield metres. What most pixels say decides, so that a few wrong ones change nothing.

    Args:
        depth: of any shape, integer millimetres (a RealSense's) or float of either unit; 0, negative or non-finite =
            invalid.

    Returns:
        The same shape, float (float32 for integers); what is invalid stays so.
    """
    if not depth.is_floating_point():
        return _from_millimetres(depth.float())
    finite = depth.isfinite()
    measured, large = finite & (depth > 0), finite & (depth > METRES_AT_MOST)
    return torch.where(2 * large.sum() > measured.sum(), _from_millimetres(depth), depth)  # a GPU's answer is not read


def metres_of_heights(heights: Tensor) -> Tensor:
    """Return heights above the table in metres, whatever unit LeRobot delivered them in.

    Most of a table is bare, so it is not the majority that decides, as for depth: one height above 10 suffices. A batch
    of millimetres without any shows nothing higher than 1 cm.

    Args:
        heights: of any shape, integer millimetres or float of either unit.

    Returns:
        The same shape, float (float32 for integers); what is not finite stays so.
    """
    if not heights.is_floating_point():
        return _from_millimetres(heights.float())
    in_millimetres = (heights.isfinite() & (heights > METRES_AT_MOST)).any()
    return torch.where(in_millimetres, _from_millimetres(heights), heights)


def _from_millimetres(lengths: Tensor) -> Tensor:
    # By a tensor: by a plain number a GPU may multiply with the rounded reciprocal, which gives other bits.
    return lengths / lengths.new_full((), MILLIMETRES_PER_METRE)


@dataclass
@ProcessorStepRegistry.register(name="symview_views")
class ViewsProcessorStep(ObservationProcessorStep):
    """Adds views of one camera to an observation; leaves alone what is already there.

    Colour is float in [0, 1] or uint8. Calibration is flat, (9,) and (16,), or square, (3, 3) and (4, 4), for all
    frames or for each; an observation without it, such as a real robot's, is taken to have the stated one.

    Args:
        views: name -> options of every view wanted, as for `lerobot_symview.views.make_view`.
        camera: the camera they are made from.
        workspace: constructor arguments of `Workspace`; by default the calibration's, or the default one.
        calibration: content of a calibration file (`lerobot_symview.calibration.file`), or nothing.
        gripper: which entries of `observation.state` are the gripper's x, y, z, yaw and aperture.
    """

    views: dict[str, dict[str, Any]] = field(default_factory=dict)
    camera: str = "side"
    workspace: dict[str, Any] = field(default_factory=dict)
    calibration: dict[str, Any] = field(default_factory=dict)
    gripper: list[int] = field(default_factory=lambda: list(range(len(keys.STATE_NAMES))))

    def __post_init__(self) -> None:
        self._views = {name: make_view(name, **options) for name, options in self.views.items()}
        stated = parse_calibration(self.calibration) if self.calibration else None
        self._stated = stated.camera(self.camera) if stated else None
        self._workspace = (stated and not self.workspace and stated.workspace) or parse_workspace(self.workspace)

    def observation(self, observation: RobotObservation) -> RobotObservation:
        """Return the observation with what is missing of its views: float32 (B, C, size, size), as any other image."""
        missing = {
            name: view
            for name, view in self._views.items()
            if not all(keys.view(self.camera, output) in observation for output in view.outputs)
        }
        if not missing:
            return observation
        needs_depth = any(view.needs_depth for view in missing.values())
        needs_gripper = any(view.needs_gripper for view in missing.values())
        batch = self._batch(observation, list(missing), needs_depth, needs_gripper)
        for view in missing.values():
            for output, images in _render(view, batch).items():
                made = images.float() / 255 if images.dtype == torch.uint8 else images[:, None]
                observation.setdefault(keys.view(self.camera, output), made)
        return observation

    def get_config(self) -> dict[str, Any]:
        """Return the constructor's arguments, which a checkpoint stores as JSON."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Leave the declared features alone: the policy names what it needs."""
        return features

    def _batch(
        self, observation: RobotObservation, views: list[str], needs_depth: bool, needs_gripper: bool
    ) -> FrameBatch:
        from lerobot_symview.views.torch_backend import (
            FrameBatch,  # needs numba, which a plugin's import must not wait for
        )

        color, depth = keys.rgb(self.camera), keys.depth(self.camera)
        needed = [color] + ([depth] if needs_depth else []) + ([keys.STATE] if needs_gripper else [])
        matrices = {keys.intrinsics(self.camera): 3, keys.world_from_cam(self.camera): 4}
        own = self._stated is None or all(key in observation for key in matrices)
        missing = [key for key in needed + (list(matrices) if own else []) if key not in observation]
        if missing:
            raise KeyError(f"the views {views} need {missing}, the observation has {sorted(observation)}")
        rgb = observation[color].detach()
        if rgb.dtype != torch.uint8:
            rgb = (rgb * 255).round().to(torch.uint8)
        height, width = rgb.shape[2:]
        if own:
            stored = (_matrices(key, observation[key], side, len(rgb)) for key, side in matrices.items())
            cameras = [stored_camera(k, pose, height, width) for k, pose in zip(*stored, strict=True)]
        else:
            cameras = [self._stated_camera(height, width)] * len(rgb)
        return FrameBatch(
            rgb,
            metres_of_depth(observation[depth].detach())[:, 0] if needs_depth else None,
            cameras,
            self._workspace,
            observation[keys.STATE].detach()[:, self.gripper] if needs_gripper else None,
        )

    def _stated_camera(self, height: int, width: int) -> Camera:
        assert self._stated is not None
        if (height, width) != (self._stated.height, self._stated.width):
            raise CalibrationError(
                f"camera {self.camera!r} is calibrated for {self._stated.height} x {self._stated.width} pixels, "
                f"the observation has {height} x {width}"
            )
        return self._stated


def _matrices(key: str, stated: Tensor, side: int, count: int) -> NDArray[np.floating]:
    """Return (count, side^2): a matrix for each frame, or one for all, which LeRobot leaves without a batch axis."""
    shapes = [(side**2,), (side, side), (count, side**2), (count, side, side)]
    if tuple(stated.shape) not in shapes:
        raise CalibrationError(f"{key} has shape {tuple(stated.shape)}, expected one of {shapes}")
    return np.broadcast_to(stated.detach().cpu().numpy().reshape(-1, side**2), (count, side**2))


def _render(view: View, batch: FrameBatch) -> dict[str, Tensor]:
    """Return each output for all frames, on their device: together by CUDA, by the compiled kernels elsewhere."""
    from lerobot_symview.views.torch_backend import can_batch, render_batch

    device = batch.rgb.device
    if device.type == "cuda" and can_batch(view):  # Apple's GPUs have no float64, which the bits depend on
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
    stacked = {output: torch.from_numpy(np.stack([image[output] for image in images])) for output in view.outputs}
    channels_first = {
        output: image.permute(0, 3, 1, 2) if image.ndim == 4 else image for output, image in stacked.items()
    }
    return {output: image.to(device) for output, image in channels_first.items()}
