"""Base class of the policies: loading, acting, and the scaling of states and actions.

`lerobot_policy_symview.inputs.scene_input` forms the network's input.
"""

from __future__ import annotations

import logging
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

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.encoders import make_encoder
from lerobot_policy_symview.inputs.camera_check import REFERENCE, check_observation, reference_image, with_reference
from lerobot_policy_symview.inputs.feature_contract import read_calibration
from lerobot_policy_symview.inputs.scene_input import make_scene_input
from lerobot_policy_symview.inputs.state import StateInput
from lerobot_policy_symview.model_card import model_card
from lerobot_policy_symview.nn.encoders.base import Encoder
from lerobot_policy_symview.processor_allowlist import check_processor_files
from lerobot_policy_symview.processor_pipelines import changed_options
from lerobot_policy_symview.processor_views import start_episodes
from lerobot_policy_symview.symmetry.augmentation import AUGMENTATIONS, random_transform
from lerobot_policy_symview.symmetry.groups import make_group
from lerobot_policy_symview.symmetry.representations import VectorRepresentation
from lerobot_policy_symview.symmetry.transforms import PlanarTransform
from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_workspace
from lerobot_symview.errors import DivergenceError
from lerobot_symview.views.tracing import is_exporting

ENDS = ("min", "max")
logger = logging.getLogger(__name__)

Stats = Mapping[str, Any]
"""`min` and `max` of a vector, (N,) each."""

MakeHead = Callable[[int, NDArray[np.float64]], nn.Module]
"""Takes n, the number of regular fields, and the actions' representation (G, A, A); returns the head."""


class Network(nn.Module):
    """An encoder and a head on its features.

    Args:
        config: the policy's configuration.
        encoder: its group is the configuration's.
        make_head: makes the head.
    """

    def __init__(self, config: SymviewConfig, encoder: Encoder, make_head: MakeHead):
        super().__init__()
        self.encoder = encoder
        self.head: Any = make_head(encoder.fields, config.actions.matrices(encoder.group, config.theta_representation))

    def forward(self, observation: Tensor, state: Tensor) -> Any:
        """Return the head's output for an observation and a state (B, D)."""
        return self.head(self.encoder(observation, state))


class SymviewPolicy(PreTrainedPolicy):
    """A reactive policy: one observation, one action, no memory.

    Its inputs and outputs have physical units: images in [0, 1], metres, radians. Every operation between them commutes
    with the network's group: the centre crop, the drawn gripper, the scaling of states and actions.

    Args:
        config: the policy's configuration.
        make_head: makes the head.
        dataset_stats: minimum and maximum of states and actions in the dataset, from which their scales follow; without
            them states and actions are not scaled.
    """

    config_class: Any = SymviewConfig
    name: Any = "symview"
    action_center: Tensor
    action_width: Tensor
    state_center: Tensor
    state_width: Tensor
    reference_image: Tensor

    def __init__(self, config: SymviewConfig, make_head: MakeHead, dataset_stats: dict[str, dict[str, Any]] | None):
        super().__init__(config)
        config.validate_features()
        read_calibration(config)
        self.config: SymviewConfig = config
        self.workspace = parse_workspace(config.workspace)
        self.scene = make_scene_input(config, self.workspace)
        self.state_input = StateInput(config, self.workspace)
        self.network = Network(config, self.make_encoder(), make_head)
        self.averaged = deepcopy(self.network).requires_grad_(False) if config.weight_averaging else None
        stats = dataset_stats or {}
        ranges = self._state_ranges(stats.get(keys.STATE))
        action = self.action_scale(stats.get(keys.ACTION), ranges)
        state = self.state_input.scale(*scale_of(ranges, config.states))
        for name, (center, width) in {"action": action, "state": state}.items():
            self.register_buffer(f"{name}_center", center)
            self.register_buffer(f"{name}_width", width)
        if config.check_camera:
            self.register_buffer(REFERENCE, reference_image(config))
        self._is_camera_checked = False

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, **options: Any) -> Self:
        """Load a policy as LeRobot does, then check that its processor files name only the policy's own steps.

        Flags, and the dataset in fine-tuning, may give the configuration another camera, calibration or view. LeRobot
        then makes the preprocessing from the configuration instead of loading it.

        Raises:
            ValueError: if a processor file names another step.
        """
        policy = super().from_pretrained(pretrained_name_or_path, **options)
        saved = check_processor_files(policy.config, str(pretrained_name_or_path), options)
        changed = changed_options(policy.config, saved) if saved is not None else []
        if changed:
            logger.info(
                "the preprocessing of %s is made anew for the camera %r (changed: %s)",
                pretrained_name_or_path,
                policy.config.seen_camera,
                ", ".join(changed),
            )
            policy.config.pretrained_path = None  # LeRobot loads the processors from here, or else makes them
        return policy

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """Load weights; averaged weights that `state_dict` lacks are initialised with the trained ones.

        Raises:
            ValueError: if `check_camera` is on and there is no image of the demonstrations.
        """
        if self.averaged is not None and not any(name.startswith("averaged.") for name in state_dict):
            trained = {name for name in state_dict if name.startswith("network.")}
            initial = {name.replace("network.", "averaged.", 1): state_dict[name].clone() for name in trained}
            state_dict = {**state_dict, **initial}
        state_dict = with_reference(state_dict, self.reference_image if self.config.check_camera else None)
        return super().load_state_dict(state_dict, strict, assign)

    def make_encoder(self) -> Encoder:
        """Return the encoder of what `network_input` returns."""
        group = make_group(self.config.group)
        return make_encoder(self.config, group, self.state_input.representation(group))

    def action_scale(self, action: Stats | None, state: Stats | None) -> tuple[Tensor, Tensor]:
        """Return centre and half-width of the network's output for the ranges of actions and states in the dataset."""
        return scale_of(action, self.config.actions)

    def _state_ranges(self, recorded: Stats | None) -> Stats | None:
        """Return the ranges of states as they are read, for the ranges of recorded states."""
        return recorded and {end: self.config.state_reader.read_range(torch.as_tensor(recorded[end])) for end in ENDS}

    def get_optim_params(self) -> Any:
        """Return all trained parameters; they share a learning rate."""
        return self.network.parameters()

    def update(self) -> None:
        """Update the averaged weights; LeRobot calls this after every optimiser step."""
        if self.averaged is not None:
            with torch.no_grad():
                for average, current in zip(self.averaged.parameters(), self.network.parameters(), strict=True):
                    average.lerp_(current, 1 - self.config.weight_averaging)

    def reset(self) -> None:
        """Start an episode. The policy has no memory, its view may have one."""
        if self.config.remembers:
            start_episodes()

    @property
    def parameter_count(self) -> int:
        """Number of trained parameters."""
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
        """Return the model card that `lerobot-train` uploads with the policy."""
        training = {} if cfg is None else {"steps": cfg.steps, "batch size": cfg.batch_size, "seed": cfg.seed}
        if dataset_meta is not None:
            training = {"episodes": dataset_meta.total_episodes, "frames": dataset_meta.total_frames} | training
        card = model_card(self.config, self.parameter_count, dataset_repo_id, training, tags=tags or ())
        card.validate()
        return card

    def draw_noise(self, samples: int, generator: torch.Generator | None = None) -> Tensor:
        """Return the noise (B, H, A) from which `predict_action_chunk` makes chunks; here, policies do not sample."""
        return self.action_center.new_zeros(samples, 1, len(self.config.action_symmetry))

    def transform_actions(self, actions: Tensor, transform: PlanarTransform) -> Tensor:
        """Return actions (B, A) for transformed scenes."""
        return self.config.actions.transform(actions, transform, absolute_yaw=False)

    @property
    def history_length(self) -> int:
        """Number of observations that the network sees."""
        return 1

    def check_first_image(self, batch: dict[str, Tensor]) -> None:
        """Compare the first observation (B, ...) with the demonstrations' image, if `check_camera` is on.

        Raises:
            CalibrationError: if it shows something else.
        """
        if self.config.check_camera and not (self._is_camera_checked or is_exporting()):
            check_observation(self.config, self.reference_image, self.scene.own_names(batch))
            self._is_camera_checked = True

    def check_action(self, action: Tensor, batch: dict[str, Tensor]) -> None:
        """Check that actions (B, A), chosen for the observations in `batch`, are finite.

        Raises:
            DivergenceError: if not; the message names what else is not finite, the weights or the observation.
        """
        if action.isfinite().all():
            return
        labels = zip(self.config.action_symmetry, action.isfinite().all(dim=0), strict=True)
        entries = ", ".join(label for label, is_finite in labels if not is_finite)
        observed = {key: value for key, value in batch.items() if isinstance(value, Tensor)}
        causes = [f"its observation ({key}) is not finite" for key in not_finite(observed)]
        if not_finite(self.state_dict()):
            causes.append("its weights are not finite (its training diverged)")
        reason = " and ".join(causes) or "a number in its network is too large"
        raise DivergenceError(f"the policy's action is not finite (in {entries}): {reason}")

    def precision(self) -> AbstractContextManager[Any]:
        """Return the autocast context of the network: bfloat16 with `--policy.dtype=bfloat16`, else none."""
        reduced = self.config.dtype == "bfloat16"
        return torch.autocast(self.action_center.device.type, torch.bfloat16) if reduced else nullcontext()

    def scaled(self, action: Tensor) -> Tensor:
        """Scale actions (B, A): the centre of each range maps to 0, its ends to -1 and 1."""
        return (action - self.action_center) / self.action_width

    def physical(self, scaled: Tensor) -> Tensor:
        """Return the actions (B, A) in metres and radians."""
        return scaled * self.action_width + self.action_center

    def random_transform(self, like: Tensor) -> PlanarTransform | None:
        """Draw a transform for each sample of `like` (B, ...), as `augmentation` says; None without augmentation."""
        if self.config.augmentation == "none":
            return None
        group = make_group(self.config.group)
        elements = AUGMENTATIONS | {"group": (group.rotations, group.reflections)}
        return random_transform(*elements[self.config.augmentation], like)

    def network_input(
        self, batch: dict[str, Tensor], transform: PlanarTransform | None = None, crop_offset: Tensor | None = None
    ) -> tuple[Any, Tensor]:
        """Return the network's input: the observation and the state (B, D).

        Args:
            batch: preprocessed observations.
            transform: planar transform of each scene; by default none.
            crop_offset: (B, 2) in [0, 1), row and column relative to the largest offset; by default the centre crop.
        """
        batch = self.scene.own_names(batch)
        observation, state = self.scene.form(batch, transform, crop_offset, shuffle=self.training)
        direction = self.scene.camera_direction(batch, transform)
        return observation, self.state_input(state, self.state_center, self.state_width, direction)


def not_finite(tensors: Mapping[str, Tensor]) -> list[str]:
    """Return the names of the tensors that contain a number that is not finite."""
    return [name for name, tensor in tensors.items() if not tensor.isfinite().all()]


def scale_of(stats: Stats | None, representation: VectorRepresentation) -> tuple[Tensor, Tensor]:
    """Return centre and half-width (N,) of a vector's range, `min` and `max`; 0 and 1 where it is unknown."""
    if stats is None:
        return torch.zeros(len(representation.dimensions)), torch.ones(len(representation.dimensions))
    return representation.scale(*(torch.as_tensor(stats[name], dtype=torch.float32) for name in ENDS))
