"""What the policies have in common: the way from an observation to the network's input, and from its output back."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from copy import deepcopy
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from huggingface_hub import ModelCard
from lerobot.policies.pretrained import PreTrainedPolicy
from numpy.typing import NDArray
from torch import Tensor, nn

from lerobot_policy_symview.configuration import LIFTING, SymviewConfig
from lerobot_policy_symview.inputs.clouds import cloud_from_depth
from lerobot_policy_symview.inputs.state import StateInput, camera_directions
from lerobot_policy_symview.inputs.voxels import voxelize
from lerobot_policy_symview.model_card import model_card
from lerobot_policy_symview.nn.encoders.convolutional import make_encoder
from lerobot_policy_symview.nn.encoders.point_cloud import POINTS
from lerobot_policy_symview.processor_allowlist import check_processor_files
from lerobot_policy_symview.processor_views import metres_of_depth, metres_of_heights
from lerobot_policy_symview.symmetry.augmentation import AUGMENTATIONS, crop, move_images, random_motion, scale_down
from lerobot_policy_symview.symmetry.groups import make_group
from lerobot_policy_symview.symmetry.representations import Motion, Symmetry
from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_calibration, parse_workspace
from lerobot_symview.geometry.gripper import gripper_image
from lerobot_symview.views import ReprojectedView

MakeHead = Callable[[int, NDArray[np.float64]], nn.Module]
"""Returns the head of an encoder with so many fields for actions that move by a representation (G, A, A)."""


class Network(nn.Module):
    """An encoder and its head.

    Args:
        config: what to build.
        inputs: the numbers beside the picture.
        make_head: what makes actions of its fields.
    """

    def __init__(self, config: SymviewConfig, inputs: StateInput, make_head: MakeHead):
        super().__init__()
        group = make_group(config.group)
        self.encoder = make_encoder(config, group, inputs.representation(group))
        self.head: Any = make_head(
            self.encoder.fields, config.actions.representation(group, config.theta_representation)
        )

    def forward(self, picture: Tensor, state: Tensor) -> Any:
        """Return what the head makes of what the policy sees."""
        return self.head(self.encoder(picture, state))


class SymviewPolicy(PreTrainedPolicy):
    """Sees, and acts at once: nothing is remembered between steps.

    Its inputs and outputs are physical: images in [0, 1], metres, radians. Everything between commutes with the
    network's group: the crop in evaluation, the drawn gripper, the scaling of states and actions.

    Args:
        config: what to build.
        make_head: what makes actions of the encoder's fields.
        dataset_stats: ranges of states and actions, which scale them.
    """

    config_class: Any = SymviewConfig
    name: Any = "symview"
    action_center: Tensor
    action_width: Tensor
    state_center: Tensor
    state_width: Tensor

    def __init__(self, config: SymviewConfig, make_head: MakeHead, dataset_stats: dict[str, dict[str, Any]] | None):
        super().__init__(config)
        config.validate_features()
        self.config: SymviewConfig = config
        self.workspace = parse_workspace(config.workspace)
        stated = parse_calibration(config.calibration) if config.calibration else None
        self.stated_camera = stated.camera(config.camera) if stated else None
        self.inputs = StateInput(config, self.workspace)
        self.network = Network(config, self.inputs, make_head)
        self.averaged = deepcopy(self.network).requires_grad_(False) if config.weight_averaging else None
        stats = dataset_stats or {}
        action = _scale(stats.get(keys.ACTION), config.actions)
        state = self.inputs.scale(*_scale(stats.get(keys.STATE), config.states))
        for name, (center, width) in {"action": action, "state": state}.items():
            self.register_buffer(f"{name}_center", center)
            self.register_buffer(f"{name}_width", width)

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, **options: Any) -> Self:
        """Load a policy, as LeRobot does, unless the processor files beside it ask for more than ours.

        Raises:
            ValueError: if they do.
        """
        policy = super().from_pretrained(pretrained_name_or_path, **options)
        check_processor_files(policy.config, str(pretrained_name_or_path), options)
        return policy

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """Load weights; an average that they lack begins at the weights themselves."""
        if self.averaged is not None and not any(name.startswith("averaged.") for name in state_dict):
            trained = {name for name in state_dict if name.startswith("network.")}
            begun = {name.replace("network.", "averaged.", 1): state_dict[name].clone() for name in trained}
            state_dict = {**state_dict, **begun}
        return super().load_state_dict(state_dict, strict, assign)

    @abstractmethod
    def best_action(self, network: Network, picture: Tensor, state: Tensor) -> Tensor:
        """Return the scaled action (B, A) by a network, the trained or the averaged one, for what that gets."""

    def get_optim_params(self) -> Any:
        """Return every parameter that is trained: one rate for all."""
        return self.network.parameters()

    def update(self) -> None:
        """Let the averaged weights follow; LeRobot calls this after every optimiser step."""
        if self.averaged is not None:
            with torch.no_grad():
                for average, current in zip(self.averaged.parameters(), self.network.parameters(), strict=True):
                    average.lerp_(current, 1 - self.config.weight_averaging)

    def reset(self) -> None:
        """Nothing is remembered between steps."""

    @property
    def parameter_count(self) -> int:
        """How many numbers are trained."""
        return sum(parameter.numel() for parameter in self.network.parameters())

    def generate_model_card(
        self,
        dataset_repo_id: str,
        model_type: str,
        license: str | None,
        tags: list[str] | None,
        cfg: Any = None,
        dataset_meta: Any = None,
    ) -> ModelCard:
        """Return the card that `lerobot-train` pushes with the policy."""
        training = {} if cfg is None else {"steps": cfg.steps, "batches of": cfg.batch_size, "seed": cfg.seed}
        if dataset_meta is not None:
            training = {"episodes": dataset_meta.total_episodes, "frames": dataset_meta.total_frames} | training
        card = model_card(self.config, self.parameter_count, dataset_repo_id, training, tags=tags or ())
        card.validate()
        return card

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return actions (B, 1, A): dx, dy, dz in metres, dyaw in radians, aperture, in the declared order."""
        return self.select_action(batch)[:, None]

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the action (B, A) for observations (B, ...)."""
        self.eval()
        with self.precision():
            scaled = self.best_action(self.averaged or self.network, *self.network_input(batch))
        return self.physical(scaled)

    def precision(self) -> AbstractContextManager[Any]:
        """Return the context in which networks compute: bfloat16 where the configuration says so."""
        reduced = self.config.dtype == "bfloat16"
        return torch.autocast(self.action_center.device.type, torch.bfloat16) if reduced else nullcontext()

    def scaled(self, action: Tensor) -> Tensor:
        """Return what the network learns of actions (B, A): the middle of the range is 0, its ends are -1 and 1."""
        return (action - self.action_center) / self.action_width

    def physical(self, scaled: Tensor) -> Tensor:
        """Return the actions (B, A) in metres and radians."""
        return scaled * self.action_width + self.action_center

    def training_input(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return `network_input` and the scaled actions (B, A), moved and cut at random if the policy is training."""
        state, action, motion, place = batch[keys.STATE], batch[keys.ACTION], None, None
        if self.training:
            motion, place = self.random_motion(state), torch.rand(len(state), 2, device=state.device)
        if motion is not None:
            action = self.config.actions.move(action, motion, absolute_yaw=False)
        return *self.network_input(batch, motion, place), self.scaled(action)

    def random_motion(self, like: Tensor) -> Motion | None:
        """Draw the motion by which `augmentation` moves each sample of `like` (B, ...); None if it moves none."""
        if self.config.augmentation == "none":
            return None
        group = make_group(self.config.group)
        motions = AUGMENTATIONS | {"group": (group.turns, group.mirrors)}
        return random_motion(*motions[self.config.augmentation], like)

    def network_input(
        self, batch: dict[str, Tensor], motion: Motion | None = None, place: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the picture and the state (B, D) that the network gets.

        Args:
            batch: preprocessed observations.
            motion: of the scene before it is seen.
            place: (B, 2) in [0, 1), which of all places images are cut at, row and column; by default the middle.
        """
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
            picture = crop(picture, self.config.crop_size, place)
        return picture, self.inputs(state, self.state_center, self.state_width, direction)

    def _images(self, batch: dict[str, Tensor]) -> Tensor:
        """Colour in [0, 1] and, for `rgbd`, height relative to the working volume (a camera's own depth in metres)."""
        color = batch[self.config.color_key]
        if self.config.modality == "rgb":
            return scale_down(color, self.config.image_size)
        assert self.config.height_key is not None
        height = batch[self.config.height_key]
        height = metres_of_heights(height) if self.config.is_computed else metres_of_depth(height)
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
            metres_of_depth(batch[keys.depth(camera)]),
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
