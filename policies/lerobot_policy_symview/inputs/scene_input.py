"""Forms the network's input from a preprocessed observation: top-down or camera images, or points in space.

`make_scene_input` chooses the strategy once, from the configuration. Everything it does commutes with the network's
group: the centre crop, the drawn gripper, the lifting of pixels to points.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod

import numpy as np
import torch
from torch import Tensor

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.inputs.clouds import POINTS, cloud_from_depth
from lerobot_policy_symview.inputs.rays import plucker_rays, transformed_rays
from lerobot_policy_symview.inputs.state import camera_directions
from lerobot_policy_symview.inputs.voxels import voxelize
from lerobot_policy_symview.symmetry.augmentation import crop, scale_down, transform_images
from lerobot_policy_symview.symmetry.transforms import PlanarTransform
from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_calibration
from lerobot_symview.geometry.camera import Camera, stored_camera
from lerobot_symview.geometry.gripper import gripper_image
from lerobot_symview.geometry.gripper_state import POSE, gripper_columns, poses_from_states
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import ReprojectedView
from lerobot_symview.views.tracing import is_exporting

logger = logging.getLogger(__name__)


class SceneInput(ABC):
    """Forms a network's input from preprocessed observations.

    Args:
        config: the policy's.
        workspace: the square on the table that the network sees.
    """

    def __init__(self, config: SymviewConfig, workspace: Workspace):
        self.config, self.workspace = config, workspace
        calibration = parse_calibration(config.camera_calibration) if config.camera_calibration else None
        self._fixed_camera = calibration.camera(config.camera) if calibration else None
        self._substitutes: set[str] = set()

    @property
    @abstractmethod
    def keys(self) -> list[str]:
        """Features of a preprocessed observation that it reads."""

    @property
    def optional_keys(self) -> list[str]:
        """Features that it reads where an observation has them: the camera's lens."""
        return []

    def own_names(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return observations with the names of the policy's camera, where those of another were not all renamed.

        Raises:
            KeyError: if the observations lack a feature of the camera.
        """
        calibration = keys.calibration(self.config.camera)
        optional = [keys.STATE] + (calibration if self._fixed_camera is not None else [])
        needed = [key for key in self.keys if key not in optional]
        missing = [key for key in needed if key not in batch]
        if not missing:
            return batch
        camera = self.config.seen_camera
        others = keys.substitutes(batch, camera, needed)
        if len(others) != 1:
            raise KeyError(
                f"the policy needs {missing}, the observation has {sorted(batch)}: name its camera with "
                "--policy.camera, or rename its image with --rename_map"
            )
        if others[0] not in self._substitutes:
            self._substitutes.add(others[0])
            logger.info("the camera %r takes the place of %r", others[0], camera)
        return keys.as_camera(batch, camera, others[0], [*needed, *calibration])

    @abstractmethod
    def form(
        self,
        batch: dict[str, Tensor],
        transform: PlanarTransform | None = None,
        crop_offset: Tensor | None = None,
        *,
        shuffle: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Return the observation and the state (B, N) of the scene.

        Args:
            batch: preprocessed observations, colour in [0, 1], depth in metres.
            transform: planar transform of each scene; by default none.
            crop_offset: (B, 2) in [0, 1), row and column relative to the largest offset; by default the centre crop.
            shuffle: sample points at random.
        """

    def downscale(self, images: Tensor) -> Tensor:
        """Reduce images (B, C, H, W) to the resolution that is needed; by default they are kept unchanged."""
        return images

    def camera_direction(self, batch: dict[str, Tensor], transform: PlanarTransform | None = None) -> Tensor | None:
        """Return unit vectors (B, 2) from the workspace centre to the camera, None unless the network gets them."""
        if not self.config.camera_direction:
            return None
        direction = camera_directions(self._calibration(batch)[1], self.workspace)
        return direction if transform is None else torch.stack(transform.apply(*direction.unbind(-1)), dim=-1)

    def _state(self, batch: dict[str, Tensor], transform: PlanarTransform | None) -> Tensor:
        state = batch[keys.STATE]
        return state if transform is None else self.config.states.transform(state, transform, absolute_yaw=True)

    def _gripper(self, state: Tensor, transform: PlanarTransform | None) -> Tensor:
        """Return the gripper's poses (B, 5); a hand without yaw turns with a transformed scene only."""
        columns = gripper_columns(self.config.state_symmetry, self.config.gripper_turns)
        assert columns is not None  # checked with the configuration
        pose: Tensor = poses_from_states(state, columns)
        if columns[POSE.index("yaw")] is None and transform is not None:
            pose[:, POSE.index("yaw")] = transform.angle
        return pose

    def _calibration(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """K (B, 9) and pose (B, 16) of the camera: the observation's, or the configuration's where it has none."""
        intrinsics, world_from_cam = keys.calibration(self.config.camera, ())
        if self._has_calibration(batch):
            return batch[intrinsics], batch[world_from_cam]
        assert self._fixed_camera is not None  # `own_names` has checked it
        state, camera = batch[keys.STATE], self._fixed_camera
        k, pose = (
            torch.as_tensor(matrix, dtype=state.dtype, device=state.device).flatten().expand(state.shape[0], -1)
            for matrix in (camera.intrinsics, camera.world_from_cam)
        )
        return k, pose

    def _has_calibration(self, batch: dict[str, Tensor]) -> bool:
        return all(key in batch for key in keys.calibration(self.config.camera, ()))

    def _lenses(self, batch: dict[str, Tensor], size: tuple[int, ...]) -> list[Camera] | None:
        """Cameras of the samples, or the one of all, if they have a lens; `size` are rows and columns of their images.

        Raises:
            CalibrationError: if a camera is invalid.
            ValueError: if the operations are recorded, which cannot depend on the observation's lens.
        """
        intrinsics, distortion = keys.intrinsics(self.config.camera), keys.distortion(self.config.camera)
        if self._has_calibration(batch):
            if distortion not in batch:
                return None
            if is_exporting():
                raise ValueError(
                    "a policy is exported for one lens: give the policy the camera's calibration, and export it with "
                    f"an observation without {', '.join(keys.calibration(self.config.camera))}"
                )
            height, width = size
            matrices, lenses = (batch[key].detach().reshape(-1, 9).cpu().numpy() for key in (intrinsics, distortion))
            pose = np.eye(4)  # rays in the camera's frame do not depend on it
            return [stored_camera(k, pose, height, width, lens) for k, lens in zip(matrices, lenses, strict=True)]
        assert self._fixed_camera is not None
        return None if self._fixed_camera.lens is None else [self._fixed_camera]


class ImageInput(SceneInput):
    """Images (B, C, crop, crop): colour in [0, 1], height for `rgbd`, the drawn gripper for `gripper_input=image`."""

    def __init__(self, config: SymviewConfig, workspace: Workspace):
        super().__init__(config, workspace)
        self._color_key, self._height_key = config.color_key, config.height_key  # once: height_key makes the view
        feature = (config.input_features or {}).get(self._color_key)
        self._dataset_size = feature.shape[-2:] if feature is not None else None

    @property
    def keys(self) -> list[str]:
        """The view's colour and height, the state, and the camera's calibration where it is used."""
        config = self.config
        features = [self._color_key, keys.STATE]
        if config.modality == "rgbd":
            assert self._height_key is not None
            features.append(self._height_key)
        if config.camera_direction or config.camera_rays:
            features += [keys.intrinsics(config.camera), keys.world_from_cam(config.camera)]
        if config.view.name == "top" and config.modality == "rgbd":
            features.append(keys.world_from_cam("top"))
        return features

    @property
    def optional_keys(self) -> list[str]:
        """The camera's lens, for the rays of its pixels."""
        return [keys.distortion(self.config.camera)] if self.config.camera_rays else []

    def form(
        self,
        batch: dict[str, Tensor],
        transform: PlanarTransform | None = None,
        crop_offset: Tensor | None = None,
        *,
        shuffle: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Return images (B, C, crop, crop) and states (B, N)."""
        images, state = self._images(batch), self._state(batch, transform)
        if self.config.camera_rays:
            rays = self._rays(batch, images)
            rays = rays if transform is None else transformed_rays(rays, transform)
            images = torch.cat([images, rays], dim=1)
        if transform is not None:
            images = transform_images(images, transform)
        if self.config.gripper_input == "image":
            gripper = gripper_image(self._gripper(state, transform), self.workspace, images.shape[-1])
            images = torch.cat([images, gripper[:, None]], dim=1)
        return crop(images, self.config.crop_size, crop_offset), state

    def downscale(self, images: Tensor) -> Tensor:
        """Average images down to the size from which crops are taken."""
        return scale_down(images, self.config.image_size)

    def _images(self, batch: dict[str, Tensor]) -> Tensor:
        """Colour in [0, 1] and, for `rgbd`, height relative to the working volume (a side camera's depth in metres)."""
        color = batch[self._color_key]
        if self.config.modality == "rgb":
            return self.downscale(color)
        assert self._height_key is not None
        height = batch[self._height_key]
        if self.config.view.name == "top":  # from straight above, depth is the camera's height less the surface's
            camera_height = batch[keys.world_from_cam("top")].reshape(-1, 4, 4)[:, 2, 3]
            height = camera_height[:, None, None, None] - height
        if self.config.view.name != "side":
            height = height / self.workspace.height_limit
        return self.downscale(torch.cat([color, height], dim=1))

    def _rays(self, batch: dict[str, Tensor], images: Tensor) -> Tensor:
        """Return the rays (B, 6, h, w) of downscaled images (B, C, h, w)."""
        size, recorded = images.shape[-2:], batch[self._color_key].shape[-2:]
        # stored observations are downscaled already; their calibration is that of the dataset's images
        calibrated = self._dataset_size if recorded == size and self._dataset_size else recorded
        cameras = self._lenses(batch, calibrated)
        return plucker_rays(*self._calibration(batch), calibrated, size, self.workspace, cameras)


class PointInput(SceneInput):
    """The camera's RGBD image lifted to space: voxels (B, 4 or 5, Z, X, Y) or points (B, P, 6 or 7)."""

    @property
    def keys(self) -> list[str]:
        """The camera's colour, depth and calibration, and the state."""
        camera = self.config.camera
        return [
            keys.rgb(camera), keys.STATE, keys.depth(camera), keys.intrinsics(camera), keys.world_from_cam(camera)
        ]  # fmt: skip

    @property
    def optional_keys(self) -> list[str]:
        """The camera's lens."""
        return [keys.distortion(self.config.camera)]

    def form(
        self,
        batch: dict[str, Tensor],
        transform: PlanarTransform | None = None,
        crop_offset: Tensor | None = None,
        *,
        shuffle: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Return voxels (B, 4 or 5, Z, X, Y) or points (B, P, 6 or 7) and states (B, N).

        A crop shifts points together with the drawn gripper; it does nothing where the gripper is not drawn.
        """
        camera, clipping = self.config.camera, ReprojectedView()
        state, dimensions = batch[keys.STATE], self.config.state_symmetry
        z = state[:, dimensions.index("z")] if "z" in dimensions else state.new_full(state.shape[:1], torch.inf)
        cloud = cloud_from_depth(
            batch[keys.rgb(camera)],
            batch[keys.depth(camera)],
            *self._calibration(batch),
            self.workspace,
            (z - clipping.clip_margin).clamp(min=clipping.clip_floor),
            self._lenses(batch, batch[keys.depth(camera)].shape[-2:]),
        )
        state = self._state(batch, transform)
        if transform is not None:
            cloud = cloud.transformed(transform)
        gripper = None
        if self.config.gripper_input == "image":
            gripper = self._gripper(state, transform)
            if crop_offset is not None:
                shift = self._margin * (0.5 - crop_offset)
                cloud, gripper[:, :2] = cloud.shifted(shift), gripper[:, :2] + shift
        if self.config.encoder == "voxel":
            return voxelize(cloud, self.workspace, gripper), state
        return cloud.sample(POINTS, shuffle, gripper), state

    @property
    def _margin(self) -> float:
        """Length in metres of what random crops cut off images."""
        return self.workspace.size * (1 - self.config.crop_size / self.config.image_size)


def make_scene_input(config: SymviewConfig, workspace: Workspace) -> SceneInput:
    """Return the input of a policy: points for the encoders of points, else images."""
    return (PointInput if config.sees_points else ImageInput)(config, workspace)
