"""Checks that a policy is equivariant, from the raw observation to the action that is sent to the robot.

```python
policy = SymviewBcPolicy.from_pretrained(folder)
assert_equivariant(policy)
```
"""

from __future__ import annotations

from copy import copy
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn import functional

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.configuration_chunks import wrist_key
from lerobot_policy_symview.inputs.history import as_frames, as_history, history_length
from lerobot_policy_symview.nn.layers import autocast_dtype
from lerobot_policy_symview.policy import SymviewPolicy
from lerobot_policy_symview.processor_pipelines import make_processors
from lerobot_policy_symview.symmetry.augmentation import transform_images
from lerobot_policy_symview.symmetry.groups import PlanarGroup, make_group
from lerobot_policy_symview.symmetry.transforms import PlanarTransform
from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_workspace
from lerobot_symview.geometry.lens import EQUIDISTANT, NUMBERS
from lerobot_symview.geometry.placement import CameraSpec

TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-10, torch.bfloat16: 5e-2}
LEAST_SCALE = 0.1
EXAMPLES = 2
ObservationBatch = dict[str, Tensor]
"""Feature -> (B, ...)."""


def assert_equivariant(
    policy: SymviewPolicy,
    processors: tuple[Any, Any] | None = None,
    observation: ObservationBatch | None = None,
    camera: Literal["stays", "moves"] | None = None,
    tolerance: float | None = None,
) -> None:
    """Raise an AssertionError unless the action for a transformed scene is the transformed action.

    Every element of the policy's group that maps pixels onto pixels is tested; the plain network, which has no group,
    is tested on D4.

    Args:
        policy: its mode is kept unchanged.
        processors: its pre- and postprocessor; by default its configuration's for gripper poses, not for joints.
        observation: a batch from an environment or dataset; by default `example_observation`.
        camera: whether the camera moves with the scene; by default it does where its image is made into the policy's
            view or lifted to points in space, and stays where the observation has the view already.
        tolerance: of `equivariance_errors`; by default 1e-4 in float32, 1e-10 in float64, 0.05 in bf16, whether by
            autocast or by `--policy.dtype`.
    """
    if tolerance is None:
        with policy.precision():
            tolerance = TOLERANCE[autocast_dtype(policy.action_center)]
    errors = equivariance_errors(policy, processors, observation, camera)
    group = checked_group(policy.config)
    violations = [
        f"{describe(group, element)}: {error:.2g}"
        for element, error in errors.items()
        if is_exact(group, element) and not error <= tolerance
    ]
    if violations:
        raise AssertionError(
            f"the policy ({policy.config.method}) is not equivariant within {tolerance:g}: {'; '.join(violations)}"
        )


def equivariance_errors(
    policy: SymviewPolicy,
    processors: tuple[Any, Any] | None = None,
    observation: ObservationBatch | None = None,
    camera: Literal["stays", "moves"] | None = None,
) -> dict[int, float]:
    """Return, for every group element, how far the action for the transformed scene is from the transformed action.

    Policies that sample get transformed noise. The distance is the largest difference of any dimension of any action,
    relative to the dimension's largest value or, if that is more, a tenth of its range in the data. Elements that do
    not map pixels onto pixels interpolate images, which alone makes a difference. Arguments are those of
    `assert_equivariant`.
    """
    config = policy.config
    preprocess, postprocess = processors or make_processors(_without_arm(config))
    if observation is None:
        history = policy.history_length
        raw = example_observation(config, policy.action_center.dtype, batch=EXAMPLES * history)
    else:
        length = history_length(observation)
        history, raw = (1, observation) if length is None else (length, as_frames(observation))
    group = checked_group(config)
    training = policy.training
    noise = policy.draw_noise(len(raw[keys.STATE]) // history, torch.Generator().manual_seed(0))

    def act(frames: ObservationBatch, noise: Tensor) -> Tensor:
        """Return the actions (H B, A) of chunks, all samples of a time together."""
        batch = preprocess(dict(frames))
        chunk = policy.predict_action_chunk(as_history(batch, history) if history > 1 else batch, noise=noise)
        actions: Tensor = postprocess(chunk.transpose(0, 1).flatten(0, 1))
        return actions

    action = act(raw, noise)
    width = policy.action_width.reshape(-1, action.shape[-1])[0]  # of the first action of a chunk
    scale = torch.maximum(action.abs().amax(dim=0), LEAST_SCALE * width.to(action))
    for first, second in config.actions.pairs:
        scale[first] = scale[second] = torch.maximum(scale[first], scale[second])
    errors = {}
    for element in range(1, group.size):
        expected = policy.transform_actions(action, PlanarTransform.of_element(group, element, action))
        moved = config.actions.transform(
            noise.flatten(0, 1), PlanarTransform.of_element(group, element, noise.flatten(0, 1)), absolute_yaw=False
        ).view_as(noise)
        actual = act(transform_observation(raw, config, group, element, camera), moved)
        errors[element] = float(((actual - expected).abs().amax(dim=0) / scale).max())
    policy.train(training)
    return errors


def _without_arm(config: SymviewConfig) -> SymviewConfig:
    """Return the configuration for observations that have the gripper's pose, which joints do not transform as."""
    on_poses = copy(config)
    on_poses.arm = {}
    return on_poses


def transform_observation(
    observation: ObservationBatch,
    config: SymviewConfig,
    group: PlanarGroup,
    element: int,
    camera: Literal["stays", "moves"] | None = None,
) -> ObservationBatch:
    """Return the observation of the scene transformed by a group element about the workspace centre.

    Arguments as for `assert_equivariant`; a camera that moves must be in the observation.
    """
    transformed = dict(observation)
    transformed[keys.STATE] = config.states.transform(
        observation[keys.STATE], PlanarTransform.of_element(group, element, observation[keys.STATE]), absolute_yaw=True
    )
    if not config.sees_points:
        for key in filter(None, (config.color_key, config.height_key)):
            if key in observation:
                transformed[key] = _transform_pixels(observation[key], group, element)
    wrist = wrist_key(config)
    if wrist in observation and group.reflects(element):
        transformed[wrist] = observation[wrist].flip(-1)
    is_raw = config.is_computed and config.color_key not in observation
    if camera == "moves" or (camera is None and (config.sees_points or is_raw)):
        for name in (config.camera, *config.merged_cameras):
            transformed |= _moved_camera(observation, config, name, group, element, is_raw=is_raw)
    return transformed


def _moved_camera(
    observation: ObservationBatch, config: SymviewConfig, camera: str, group: PlanarGroup, element: int, *, is_raw: bool
) -> ObservationBatch:
    """Return the calibration of a camera that moves with the scene and, if its view is `is_raw`, its images."""
    moved: ObservationBatch = {}
    key = keys.world_from_cam(camera)
    pose = observation[key].double().view(-1, 4, 4).clone()
    center = pose.new_tensor([*parse_workspace(config.workspace).center, 0.0])
    rotation = torch.eye(3, dtype=pose.dtype, device=pose.device)
    rotation[:2, :2] = torch.from_numpy(group.rotation()[element])
    pose[:, :3, :3] = rotation @ pose[:, :3, :3]  # left-handed after a reflection, as the scene is
    pose[:, :3, 3] = (pose[:, :3, 3] - center) @ rotation.T + center
    if is_raw and group.reflects(element):
        moved |= _reflected_image(observation, config, camera)
        pose[:, :3, 0] *= -1  # right-handed again, as views require: the image is reflected instead
    moved[key] = pose.flatten(1).to(observation[key].dtype)
    return moved


def _reflected_image(observation: ObservationBatch, config: SymviewConfig, camera: str) -> ObservationBatch:
    """Return a camera's images with reversed columns, and the intrinsics and lens that belong to them."""
    reflected = {key: observation[key].flip(-1) for key in config.raw_keys(camera)}
    key = keys.intrinsics(camera)
    k = observation[key].clone()
    k[:, 2] = reflected[keys.rgb(camera)].shape[-1] - 1 - k[:, 2]
    reflected[key] = k
    key = keys.distortion(camera)
    if key in observation:
        lens = observation[key].clone()
        lens[:, 4] *= torch.where(lens[:, 0] == NUMBERS[EQUIDISTANT], 1, -1)  # p2, which an equidistant lens lacks
        reflected[key] = lens
    return reflected


def example_observation(
    config: SymviewConfig, dtype: torch.dtype = torch.float32, batch: int = EXAMPLES
) -> ObservationBatch:
    """Return random images, a camera's calibration and gripper poses for a policy, the same at every call."""
    generator = torch.Generator().manual_seed(0)
    placed = CameraSpec(name=config.camera).place(parse_workspace(config.workspace))
    # a square rotated by 45 degrees needs 1.41 times its side
    side = placed.height if config.sees_points else 3 * config.crop_size // 2
    state = torch.rand(batch, len(config.state_symmetry), generator=generator, dtype=dtype) - 0.5
    limits = {"x": (0.0, 0.3), "y": (0.0, 0.3), "z": (0.12, 0.15), "aperture": (0.5, 1.0)}
    for i, label in enumerate(config.state_symmetry):
        center, extent = limits.get(label, (0.0, 2.0))
        state[:, i] = center + extent * state[:, i]
    observation = {
        config.color_key: _blotches(batch, 3, side, generator).to(dtype),
        keys.STATE: state,
    }
    wrist = wrist_key(config)
    if wrist is not None:
        observation[wrist] = _blotches(batch, 3, side, generator).to(dtype)[..., : side * 3 // 4, :]
    if config.modality == "rgbd" and config.height_key:
        depth = _blotches(batch, 1, side, generator).to(dtype)
        observation[config.height_key] = 0.7 + 0.2 * depth if not config.is_computed else 0.2 * depth
    for name in {config.camera, config.seen_camera}:
        for key, matrix in (
            (keys.intrinsics(name), placed.intrinsics),
            (keys.world_from_cam(name), placed.world_from_cam),
        ):
            observation[key] = torch.tensor(matrix, dtype=dtype).flatten().expand(batch, -1).clone()
    return observation


def _transform_pixels(images: Tensor, group: PlanarGroup, element: int) -> Tensor:
    if not is_exact(group, element):
        return transform_images(images, PlanarTransform.of_element(group, element, images.flatten(1)))
    flipped = images.flip(-1) if group.reflects(element) else images
    return torch.rot90(flipped, 4 * (element % group.rotations) // group.rotations, (-2, -1))


def _blotches(batch: int, channels: int, side: int, generator: torch.Generator) -> Tensor:
    """Return smooth random images with values in [0, 1]."""
    coarse = torch.rand(batch, channels, 8, 8, generator=generator)
    return functional.interpolate(coarse, (side, side), mode="bilinear")


def checked_group(config: SymviewConfig) -> PlanarGroup:
    """Return the group on which a policy is tested."""
    return make_group("D4" if config.group == "C1" else config.group)


def is_exact(group: PlanarGroup, element: int) -> bool:
    """Whether an element maps the pixels of a square image onto pixels."""
    return 4 * (element % group.rotations) % group.rotations == 0


def describe(group: PlanarGroup, element: int) -> str:
    """Return a description such as `reflected, rotated by 90 degrees`."""
    reflected = "reflected, " if group.reflects(element) else ""
    return f"{reflected}rotated by {360 * (element % group.rotations) / group.rotations:g} degrees"
