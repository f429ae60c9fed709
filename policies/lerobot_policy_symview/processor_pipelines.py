"""Preprocessing and postprocessing pipelines of the policies."""

from __future__ import annotations

import json
from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline
from lerobot.processor.factory import make_default_policy_processor_steps, make_policy_processor_pipelines

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.inputs.depth_reader import delivered_units
from lerobot_policy_symview.processor_joints import JointsProcessorStep, JointTargetsProcessorStep
from lerobot_policy_symview.processor_state import StateProcessorStep
from lerobot_policy_symview.processor_views import ViewsProcessorStep

OWN_STEPS = (JointsProcessorStep, StateProcessorStep, ViewsProcessorStep, JointTargetsProcessorStep)


def make_processors(
    config: SymviewConfig,
    dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None,
    depth_units: dict[str, float] | None = None,
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]:
    """Return LeRobot's default preprocessor and postprocessor with our steps: joints, the state, depth, and the views.

    Two turn joints into the gripper's pose and actions into joints, if the policy was trained with an arm's. One reads
    states of other conventions, if it was trained with one. One converts depth to metres and renders the policy's view
    if an observation lacks it.

    Args:
        config: the policy's configuration.
        dataset_stats: dataset statistics for LeRobot's normaliser.
        depth_units: feature -> metres per unit of depth; by default the units in which LeRobot's loader delivers the
            depth features of the training dataset.

    Raises:
        ValueError: if the view uses the gripper's pose and the declared state lacks it.
    """
    steps = make_default_policy_processor_steps(config, dataset_stats)
    reader = config.state_reader
    return make_policy_processor_pipelines(
        input_steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            JointsProcessorStep(config.arm),
            StateProcessorStep(list(reader.names), list(reader.origin)),
            steps.to_device,
            ViewsProcessorStep(
                views=config.views_to_make,
                camera=config.camera,
                workspace=config.workspace,
                calibration=config.camera_calibration,
                gripper=config.gripper_indices,
                depth_units=_delivered_units(config) if depth_units is None else depth_units,
                augmentation=config.camera_augmentation,
                require_views=config.check_camera,
            ),
            steps.normalize,
        ],
        output_steps=[
            steps.unnormalize,
            steps.to_cpu,
            JointTargetsProcessorStep(config.arm, config.max_joint_step, config.max_arm_error, config.unreachable),
        ],
    )


def changed_options(config: SymviewConfig, saved: dict[str, dict[str, Any]]) -> list[str]:
    """Return the options of our steps that flags or a dataset gave another value than a checkpoint's `saved`.

    Steps and options that the checkpoint does not have yet had their defaults.
    """
    changed = []
    for step in (step for pipeline in make_processors(config) for step in pipeline.steps):
        if isinstance(step, OWN_STEPS):
            options, defaults = (json.loads(json.dumps(one.get_config())) for one in (step, type(step)()))
            known = saved.get(type(step)._registry_name, {})
            changed += [name for name, value in options.items() if known.get(name, defaults[name]) != value]
    return changed


def _delivered_units(config: SymviewConfig) -> dict[str, float]:
    """Return the units of the training dataset's depth, by the names of the policy's camera."""
    meta = getattr(config, "_runtime_dataset_meta", None)  # set by LeRobot before it makes the processors
    if meta is None:
        return {}
    units = delivered_units(meta)
    named = config.own_names({key: units.get(key) for key in meta.features})
    return {key: unit for key, unit in named.items() if unit is not None}
