"""The policies of cells, ours and LeRobot's own, with what they see of an observation."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any, cast

import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies import make_policy
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors
from lerobot.utils.constants import IMAGENET_STATS
from torch import Tensor

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.inputs.scene_input import make_scene_input
from lerobot_policy_symview.processor_pipelines import make_processors
from lerobot_policy_symview.rl.rollouts import Actor, metric_depth
from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_workspace
from symview_eval.experiments.grid import Cell

SIGHT = "sight"
"""Folder of a checkpoint with the configuration of what a policy of LeRobot's own sees."""


class ForeignActor(Actor):
    """A policy of LeRobot's own, which sees the image that one of ours would see, at the same size, and the state.

    Args:
        policy: the policy.
        processors: its preprocessor and postprocessor, LeRobot's.
        sight: configuration of the policy of ours.
    """

    def __init__(self, policy: Any, processors: tuple[Any, Any], sight: SymviewConfig):
        self.policy = policy
        self.preprocessor, self.postprocessor = processors
        self.scene = make_scene_input(sight, parse_workspace(sight.workspace))
        self._render = make_processors(sight, depth_units=metric_depth(sight))[0]

    @property
    def remembers(self) -> bool:
        """Policies of LeRobot's own carry out chunks."""
        return True

    def copy(self) -> ForeignActor:
        """Return an actor with a copy of the policy as it is now."""
        return ForeignActor(deepcopy(self.policy), (self.preprocessor, self.postprocessor), self.scene.config)

    def see(self, observation: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the view or image at the size that the policy takes, and the state."""
        rendered: dict[str, Tensor] = self._render(observation)
        seen = {name: rendered[name] for name in self.scene.keys}
        return {name: self.scene.downscale(values) if values.ndim == 4 else values for name, values in seen.items()}

    def finish(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the batch as LeRobot's preprocessor normalises it."""
        finished: dict[str, Tensor] = self.preprocessor(batch)
        return finished


def is_ours(cell: Cell) -> bool:
    """Whether a cell's policy is one of this package."""
    return issubclass(PreTrainedConfig.get_choice_class(cell.policy_type), SymviewConfig)


def policy_config(cell: Cell, device: str) -> PreTrainedConfig:
    """Return the configuration of a cell's policy; see `sight` for what the policy sees."""
    if is_ours(cell):
        return sight(cell, device)
    return make_policy_config(cell.policy_type, device=device, push_to_hub=False, **cell.policy_settings)


def sight(cell: Cell, device: str) -> SymviewConfig:
    """Return the configuration of a cell's policy; for one of LeRobot's own, of one of ours that sees the same."""
    if is_ours(cell):
        options = cell.policy_settings | cell.row.policy_options
        config = cast(SymviewConfig, make_policy_config(cell.policy_type, device=device, push_to_hub=False, **options))
    else:
        options = {"crop_size": cell.scale.crop_size} | cell.row.policy_options
        config = SymviewBcConfig(device=device, push_to_hub=False, **options)
    config.limit_view()
    return config


def make_actor(cell: Cell, dataset: Any, device: str) -> Actor:
    """Return a cell's untrained policy.

    Args:
        cell: the cell.
        dataset: `LeRobotDataset` of its demonstrations.
        device: PyTorch device of the network.
    """
    config = policy_config(cell, device)
    if isinstance(config, SymviewConfig):
        return Actor(cast(Any, make_policy(config, ds_meta=dataset.meta)))
    seen, stats = sight(cell, device), dataset.meta.stats
    seen.set_dataset_feature_metadata(dataset.meta.features)
    config.input_features = {
        seen.color_key: PolicyFeature(FeatureType.VISUAL, (3, seen.image_size, seen.image_size)),
        keys.STATE: PolicyFeature(FeatureType.STATE, tuple(dataset.meta.features[keys.STATE]["shape"])),
    }
    config.output_features = {
        keys.ACTION: PolicyFeature(FeatureType.ACTION, tuple(dataset.meta.features[keys.ACTION]["shape"]))
    }
    imagenet = {name: torch.tensor(values) for name, values in IMAGENET_STATS.items()}  # LeRobot's default for images
    processors = make_pre_post_processors(config, dataset_stats=stats | {seen.color_key: imagenet})
    policy: Any = get_policy_class(config.type)
    return ForeignActor(policy(config).to(device), processors, seen)


def save_actor(actor: Actor, folder: Path) -> None:
    """Write a policy's checkpoint."""
    for saved in (actor.policy, actor.preprocessor, actor.postprocessor):
        saved.save_pretrained(folder)
    if isinstance(actor, ForeignActor):
        actor.scene.config.save_pretrained(folder / SIGHT)


def load_actor(cell: Cell, folder: Path) -> Actor:
    """Return a cell's trained policy from a checkpoint of `save_actor`."""
    policy: Any = get_policy_class(cell.policy_type).from_pretrained(folder)
    if is_ours(cell):
        return Actor(policy)
    processors = make_pre_post_processors(policy.config, str(folder))
    return ForeignActor(policy, processors, cast(SymviewConfig, PreTrainedConfig.from_pretrained(folder / SIGHT)))
