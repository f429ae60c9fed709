"""Pre- and postprocessing of the policies."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline
from lerobot.processor.factory import make_default_policy_processor_steps, make_policy_processor_pipelines

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.processor_views import ViewsProcessorStep


def make_processors(
    config: SymviewConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]:
    """Return LeRobot's usual pipelines, with the policy's view computed where an observation lacks it.

    Raises:
        ValueError: if that view needs the gripper's pose and the declared state has none.
    """
    steps = make_default_policy_processor_steps(config, dataset_stats)
    return make_policy_processor_pipelines(
        input_steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            steps.to_device,
            ViewsProcessorStep(
                views=config.computed_views,
                camera=config.camera,
                workspace=config.workspace,
                calibration=config.calibration,
                gripper=config.gripper_entries,
            ),
            steps.normalize,
        ],
        output_steps=[steps.unnormalize, steps.to_cpu],
    )
