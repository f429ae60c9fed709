"""Errors of a calibration, for experiments on how exact one must be."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

import numpy as np

from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.camera import Camera


@dataclass(frozen=True)
class Miscalibration:
    """How far a camera's stated calibration is from the true one; its direction is drawn for every episode.

    Raises:
        OptionError: if an error is negative, not finite, or as large as what it concerns.
    """

    position: float = 0.0
    """Distance between the stated and the true position, metres."""
    rotation_deg: float = 0.0
    """Angle between the stated and the true orientation, degrees."""
    focal: float = 0.0
    """Relative error of the focal length."""

    def __post_init__(self) -> None:
        if not all(0 <= error < np.inf for error in astuple(self)):
            raise OptionError(f"errors of a calibration must be finite and not negative, got {self}")
        if self.rotation_deg > 180 or self.focal >= 1:
            raise OptionError(f"rotation_deg must be at most 180 and focal less than 1, got {self}")

    def __bool__(self) -> bool:
        return any(astuple(self))

    def stated(self, camera: Camera, rng: np.random.Generator) -> Camera:
        """Return the camera as its wrong calibration states it.

        Args:
            camera: as it is.
            rng: draws the directions of the position's error and of the rotation's axis, and the focal length's sign.
        """
        from scipy.spatial.transform import Rotation

        toward, axis = rng.standard_normal((2, 3))
        sign = rng.choice([-1.0, 1.0])
        rotation = Rotation.from_rotvec(np.deg2rad(self.rotation_deg) * axis / np.linalg.norm(axis))
        world_from_cam = camera.world_from_cam.copy()
        world_from_cam[:3, :3] = rotation.as_matrix() @ world_from_cam[:3, :3]
        world_from_cam[:3, 3] += self.position * toward / np.linalg.norm(toward)
        intrinsics = camera.intrinsics.copy()
        intrinsics[[0, 1], [0, 1]] *= 1 + sign * self.focal
        return replace(camera, intrinsics=intrinsics, world_from_cam=world_from_cam)
