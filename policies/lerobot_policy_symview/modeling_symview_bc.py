"""The behaviour-cloning policy."""

from __future__ import annotations

from contextlib import nullcontext
from copy import deepcopy
from typing import Any, Literal

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor, nn

from lerobot_policy_symview.augmentation import center_crop, move_images, random_crop, random_motion, scale_down
from lerobot_policy_symview.clouds import cloud_from_depth
from lerobot_policy_symview.configuration_symview_bc import LIFTING, SymviewBcConfig
from lerobot_policy_symview.encoders import ENCODERS
from lerobot_policy_symview.groups import make_group
from lerobot_policy_symview.heads import RegressionHead
from lerobot_policy_symview.layers import RelaxedConv2d
from lerobot_policy_symview.point_encoder import POINTS
from lerobot_policy_symview.processor_views import metres
from lerobot_policy_symview.state_input import StateInput, camera_directions
from lerobot_policy_symview.symmetry import Motion, Symmetry
from lerobot_policy_symview.voxels import voxelize
from lerobot_symview import keys
from lerobot_symview.calibration import parse_calibration, parse_workspace
from lerobot_symview.gripper import gripper_image
from lerobot_symview.views import ReprojectedView


class Network(nn.Module):
    """An encoder and its head.

    Args:
        config: what to build.
        inputs: the numbers beside the picture.
    """

    def __init__(self, config: SymviewBcConfig, inputs: StateInput):
        super().__init__()
        group = make_group(config.group)
        self.encoder = ENCODERS[config.encoder](config, group, inputs.representation(group))
        actions = config.actions.representation(group, config.theta_representation)
        self.head = RegressionHead(self.encoder.fields, actions)

    def forward(self, picture: Tensor, state: Tensor) -> Tensor:
        """Map what the policy sees to scaled actions (B, A)."""
        actions: Tensor = self.head(self.encoder(picture, state))
        return actions


class SymviewBcPolicy(PreTrainedPolicy):
    """Predicts the expert's action from one observation by least squares.

    Its inputs and outputs are physical: images in [0, 1], metres, radians. Everything between commutes with the
    network's group: the crop in evaluation, the drawn gripper, the scaling of states and actions.
    """

    config_class = SymviewBcConfig
    name = "symview_bc"
    action_center: Tensor
    action_width: Tensor
    state_center: Tensor
    state_width: Tensor

    def __init__(self, config: SymviewBcConfig, dataset_stats: dict[str, dict[str, Any]] | None = None, **kwargs: Any):
        super().__init__(config)
        config.validate_features()
        self.config: SymviewBcConfig = config
        self.workspace = parse_workspace(config.workspace)
        stated = parse_calibration(config.calibration) if config.calibration else None
        self.stated_camera = stated.camera(config.camera) if stated else None
        self.inputs = StateInput(config, self.workspace)
        self.network = Network(config, self.inputs)
        self.averaged = deepcopy(self.network).requires_grad_(False) if config.weight_averaging else None
        stats = dataset_stats or {}
        action = _scale(stats.get(keys.ACTION), config.actions)
        state = self.inputs.scale(*_scale(stats.get(keys.STATE), config.states))
        for name, (center, width) in {"action": action, "state": state}.items():
            self.register_buffer(f"{name}_center", center)
            self.register_buffer(f"{name}_width", width)

    def get_optim_params(self) -> Any:
        """Return every parameter that is trained: one rate for all."""
        return self.network.parameters()

    def reset(self) -> None:
        """Nothing is remembered between steps."""

    def update(self) -> None:
        """Let the averaged weights follow; LeRobot calls this after every optimiser step."""
        if self.averaged is not None:
            with torch.no_grad():
                for average, current in zip(self.averaged.parameters(), self.network.parameters(), strict=True):
                    average.lerp_(current, 1 - self.config.weight_averaging)

    def forward(
        self, batch: dict[str, Tensor], reduction: Literal["mean", "none"] = "mean"
    ) -> tuple[Tensor, dict[str, Any]]:
        """Return the squared error of the scaled action, mean or (B,), and what else the log should show.

        That is nothing but for relaxed networks: reading a number from a GPU would make every step wait for it.
        """
        motion = None
        if self.training and self.config.augmentation != "none":
            motion = random_motion(self.config.augmentation, batch[keys.STATE])
        action = batch[keys.ACTION]
        if motion is not None:
            action = self.config.actions.move(action, motion, absolute_yaw=False)
        picture, state = self.network_input(batch, motion)
        features = self.network.encoder(picture, state)
        errors = self.network.head.loss(features, (action - self.action_center) / self.action_width).mean(dim=1)
        output = {}
        if self.config.encoder == "relaxed":
            asymmetry = torch.stack(
                [layer.asymmetry() for layer in self.network.modules() if isinstance(layer, RelaxedConv2d)]
            ).sum()
            output["asymmetry"] = asymmetry.item()
            errors = errors + self.config.relaxation_weight * asymmetry
        return (errors if reduction == "none" else errors.mean()), output

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return actions (B, 1, A): dx, dy, dz in metres, dyaw in radians, aperture, in the declared order."""
        return self.select_action(batch)[:, None]

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the action (B, A) for observations (B, ...)."""
        self.eval()
        network = self.network if self.averaged is None else self.averaged
        reduced = self.config.dtype == "bfloat16"
        with torch.autocast(self.action_center.device.type, torch.bfloat16) if reduced else nullcontext():
            scaled: Tensor = network(*self.network_input(batch))
        return scaled * self.action_width + self.action_center

    def network_input(self, batch: dict[str, Tensor], motion: Motion | None = None) -> tuple[Tensor, Tensor]:
        """Return the picture and the state (B, D) that the network gets, of the scene after a motion."""
        state = batch[keys.STATE]
        direction = None
        if self.config.camera_direction:
            direction = camera_directions(self._calibration(batch)[1], self.workspace)
        picture = self._points(batch, motion) if self.config.encoder in LIFTING else self._images(batch)
        if motion is not None:
            state = self.config.states.move(state, motion, absolute_yaw=True)
            if self.config.encoder not in LIFTING:
                picture = move_images(picture, motion)
            if direction is not None:
                direction = torch.stack(motion.move(*direction.unbind(-1)), dim=-1)
        if self.config.gripper_input == "image":
            picture = torch.cat([picture, self._gripper(state, picture.shape[-1])[:, None]], dim=1)
        if self.config.encoder not in LIFTING:
            crop = random_crop if self.training else center_crop
            picture = crop(picture, self.config.crop_size)
        return picture, self.inputs(state, self.state_center, self.state_width, direction)

    def _images(self, batch: dict[str, Tensor]) -> Tensor:
        """Colour in [0, 1] and, for `rgbd`, height relative to the working volume (a camera's own depth in metres)."""
        color = batch[self.config.color_key]
        if self.config.modality == "rgb":
            return scale_down(color, self.config.image_size)
        assert self.config.height_key is not None
        height = metres(batch[self.config.height_key])
        if self.config.view == "top":  # from straight above, depth is the camera's height less the surface's
            camera_height = batch[keys.world_from_cam("top")].reshape(-1, 4, 4)[:, 2, 3]
            height = camera_height[:, None, None, None] - height
        if self.config.view != "side":
            height = height / self.workspace.height_limit
        return scale_down(torch.cat([color, height], dim=1), self.config.image_size)

    def _points(self, batch: dict[str, Tensor], motion: Motion | None) -> Tensor:
        """The camera's image lifted to space, as voxels (B, 4, Z, X, Y) or as points (B, P, 6)."""
        camera, view = self.config.camera, ReprojectedView()
        state, entries = batch[keys.STATE], self.config.state_symmetry
        gripper_z = state[:, entries.index("z")] if "z" in entries else state.new_full((len(state),), torch.inf)
        cloud = cloud_from_depth(
            batch[keys.rgb(camera)],
            metres(batch[keys.depth(camera)]),
            *self._calibration(batch),
            self.workspace,
            (gripper_z - view.clip_margin).clamp(min=view.clip_floor),
        )
        if motion is not None:
            cloud = cloud.moved(motion)
        if self.config.encoder == "voxel":
            return voxelize(cloud, self.workspace)
        return cloud.sample(POINTS, shuffle=self.training)

    def _calibration(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """K (B, 9) and pose (B, 16) of the camera: the observation's own, or the ones stated for a camera without."""
        names = [keys.intrinsics(self.config.camera), keys.world_from_cam(self.config.camera)]
        if all(name in batch for name in names):
            return batch[names[0]], batch[names[1]]
        if self.stated_camera is None:
            raise KeyError(f"the method {self.config.method!r} needs {names}, the observation has {sorted(batch)}")
        state, stated = batch[keys.STATE], self.stated_camera
        k, pose = (
            torch.as_tensor(matrix, dtype=state.dtype, device=state.device).flatten().expand(len(state), -1)
            for matrix in (stated.intrinsics, stated.world_from_cam)
        )
        return k, pose

    def _gripper(self, state: Tensor, pixels: int) -> Tensor:
        """Draw the gripper (B, pixels, pixels)."""
        entries = [state[:, self.config.state_symmetry.index(kind)] for kind in keys.STATE_NAMES]
        picture: Tensor = gripper_image(torch.stack(entries, dim=-1), self.workspace, pixels)
        return picture


def _scale(stats: dict[str, Any] | None, symmetry: Symmetry) -> tuple[Tensor, Tensor]:
    if stats is None:
        return torch.zeros(len(symmetry.entries)), torch.ones(len(symmetry.entries))
    return symmetry.scale(*(torch.as_tensor(stats[name], dtype=torch.float32) for name in ("min", "max")))
