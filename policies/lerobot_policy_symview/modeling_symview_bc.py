"""The behaviour-cloning policy."""

from __future__ import annotations

import math
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor
from torch.nn import functional

from lerobot_policy_symview.augmentation import center_crop, random_crop, turn_images
from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.encoders import ENCODERS
from lerobot_policy_symview.processor_views import metres
from lerobot_policy_symview.symmetry import symmetric_range, turn
from lerobot_symview import keys
from lerobot_symview.gripper import gripper_image
from lerobot_symview.workspace import Workspace


class SymviewBcPolicy(PreTrainedPolicy):
    """Predicts the expert's action from one observation by least squares.

    Its inputs and outputs are physical: images in [0, 1], metres, radians. Everything between commutes with D4 when the
    encoder is equivariant: the crop in evaluation, the drawn gripper, the scaling of the action.
    """

    config_class = SymviewBcConfig
    name = "symview_bc"

    def __init__(self, config: SymviewBcConfig, dataset_stats: dict[str, dict[str, Any]] | None = None, **kwargs: Any):
        super().__init__(config)
        config.validate_features()
        self.config: SymviewBcConfig = config
        workspace = dict(config.workspace)
        self.workspace = Workspace(**(workspace | {"center": tuple(workspace["center"])}))
        self.network = ENCODERS[config.encoder](
            channels=config.channels,
            crop_size=config.crop_size,
            width=config.width,
            action_kinds=config.action_symmetry,
            theta_representation=config.theta_representation,
            initialize=not config.pretrained_path,
        )
        center, width = torch.zeros(len(config.action_symmetry)), torch.ones(len(config.action_symmetry))
        if dataset_stats is not None and keys.ACTION in dataset_stats:
            stats = dataset_stats[keys.ACTION]
            minimum, maximum = (torch.as_tensor(stats[name], dtype=torch.float32) for name in ("min", "max"))
            center, width = symmetric_range(minimum, maximum, config.action_symmetry)
        self.register_buffer("action_center", center)
        self.register_buffer("action_width", width)

    def get_optim_params(self) -> Any:
        """Return every parameter: one rate for all."""
        return self.parameters()

    def reset(self) -> None:
        """Nothing is remembered between steps."""

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Return the mean squared error of the scaled action, and it again under `mse` for the log."""
        images, state, action = self._images(batch), batch[keys.STATE], batch[keys.ACTION]
        if self.training and self.config.rotation_augmentation:
            angle = torch.rand(len(state), device=state.device, dtype=state.dtype) * 2 * math.pi
            images = turn_images(images, angle)
            state = turn(state, self.config.state_symmetry, angle, absolute_yaw=True)
            action = turn(action, self.config.action_symmetry, angle, absolute_yaw=False)
        channels = self._with_gripper(images, state)
        crop = random_crop if self.training else center_crop
        predicted = self.network(crop(channels, self.config.crop_size))
        loss = functional.mse_loss(predicted, (action - self.action_center) / self.action_width)
        return loss, {"mse": loss.item()}

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return actions (B, 1, A): dx, dy, dz in metres, dyaw in radians, aperture, in the declared order."""
        return self.select_action(batch)[:, None]

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the action (B, A) for observations (B, ...)."""
        self.eval()
        channels = self._with_gripper(self._images(batch), batch[keys.STATE])
        scaled: Tensor = self.network(center_crop(channels, self.config.crop_size))
        return scaled * self.action_width + self.action_center

    def _images(self, batch: dict[str, Tensor]) -> Tensor:
        """Colour in [0, 1] and, for `rgbd`, height relative to the working volume (a camera's own depth in metres)."""
        color = batch[self.config.color_key]
        if self.config.modality == "rgb":
            return color
        assert self.config.height_key is not None
        height = metres(batch[self.config.height_key])
        if self.config.view == "top":  # from straight above, depth is the camera's height less the surface's
            camera_height = batch[keys.world_from_cam("top")].reshape(-1, 4, 4)[:, 2, 3]
            height = camera_height[:, None, None, None] - height
        if self.config.view != "side":
            height = height / self.workspace.height_limit
        return torch.cat([color, height], dim=1)

    def _with_gripper(self, images: Tensor, state: Tensor) -> Tensor:
        """Append the gripper to images (B, C, H, W): its picture and height if wanted, and its aperture."""
        entry = {kind: state[:, i] for i, kind in enumerate(self.config.state_symmetry)}
        constants = [entry["aperture"]]
        pictures = []
        if self.config.gripper_input == "image":
            gripper = torch.stack([entry[kind] for kind in ("x", "y", "z", "yaw", "aperture")], dim=-1)
            pictures.append(gripper_image(gripper, self.workspace, images.shape[-1])[:, None])
            constants.append(entry["z"] / self.workspace.height_limit)
        planes = [value[:, None, None, None].expand(-1, 1, *images.shape[-2:]) for value in constants]
        return torch.cat([images, *pictures, *planes], dim=1)
