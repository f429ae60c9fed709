"""One camera in the observations of a running policy: its images, and its calibration there or a fixed one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_symview import keys
from lerobot_symview.datasets.features import check_depth_size
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera, aligned_depth, stored_camera
from lerobot_symview.geometry.lens import STORED


@dataclass(frozen=True)
class ObservedCamera:
    """Reader of a camera's images and calibration.

    Args:
        name: of the camera.
        fixed: its calibration where an observation has none.
    """

    name: str
    fixed: Camera | None = None

    def needed(self, observation: Mapping[str, Tensor], *, depth: bool) -> list[str]:
        """Return the features that an observation must have: images, and calibration where it is not fixed."""
        images = [keys.rgb(self.name), *([keys.depth(self.name)] if depth else [])]
        return images + self.missing_matrices(observation)

    def missing_matrices(self, observation: Mapping[str, Tensor]) -> list[str]:
        """Return the features of the calibration that an observation lacks, where it is not fixed."""
        return [] if self.fixed is not None else [key for key in self.matrices if key not in observation]

    @property
    def matrices(self) -> dict[str, tuple[int, ...]]:
        """Features of the calibration -> shape of the matrix."""
        return {keys.intrinsics(self.name): (3, 3), keys.world_from_cam(self.name): (4, 4)}

    def colors(self, observation: Mapping[str, Tensor]) -> Tensor:
        """Return the colour images (B, 3, H, W) uint8."""
        rgb = observation[keys.rgb(self.name)].detach()
        return rgb if rgb.dtype == torch.uint8 else (rgb * 255).round().to(torch.uint8)

    def aligned_depth(self, observation: Mapping[str, Tensor], cameras: list[Camera]) -> Tensor:
        """Return depth (B, H, W), metres, in the pixels of the colour images.

        Raises:
            DatasetError: if its size is not that of the colour images, and the calibration has no depth sensor.
        """
        depth = observation[keys.depth(self.name)][:, 0]
        if all(camera.depth_sensor is None for camera in cameras):
            check_depth_size(self.name, depth.shape[1:], (cameras[0].height, cameras[0].width))
            return depth
        images = [aligned_depth(image, camera) for image, camera in zip(depth.cpu().numpy(), cameras, strict=True)]
        return torch.from_numpy(np.stack(images)).to(depth.device)

    def cameras(self, observation: Mapping[str, Tensor]) -> list[Camera]:
        """Return the calibrated camera of each frame: the observation's, else the fixed one.

        Raises:
            CalibrationError: if the observation's is invalid, or the fixed one is for images of another size.
        """
        count, _, height, width = observation[keys.rgb(self.name)].shape
        if all(key in observation for key in self.matrices):
            shapes = self.matrices | {
                keys.distortion(self.name): (STORED,),
                keys.depth_intrinsics(self.name): (3, 3),
                keys.color_from_depth(self.name): (4, 4),
            }
            stored = keys.calibration(self.name, observation)
            names = [keys.parameter(key) for key in stored]
            columns = (_numbers(key, observation[key], shapes[key], count) for key in stored)
            return [
                stored_camera(height=height, width=width, **dict(zip(names, numbers, strict=True)))
                for numbers in zip(*columns, strict=True)
            ]
        camera = self.fixed
        assert camera is not None
        if (height, width) != (camera.height, camera.width):
            raise CalibrationError(
                f"camera {self.name!r} is calibrated for {camera.height} x {camera.width} pixels, "
                f"the observation has {height} x {width}"
            )
        return [camera] * count


def _numbers(key: str, numbers: Tensor, shape: tuple[int, ...], count: int) -> NDArray[np.floating]:
    """Return (count, N): numbers for each frame, or for all, which LeRobot leaves without a batch axis."""
    flat = (math.prod(shape),)
    shapes = list(dict.fromkeys([flat, shape, (count, *flat), (count, *shape)]))
    if tuple(numbers.shape) not in shapes:
        raise CalibrationError(f"{key} has shape {tuple(numbers.shape)}, expected one of {shapes}")
    return np.broadcast_to(numbers.detach().cpu().numpy().reshape(-1, *flat), (count, *flat))
