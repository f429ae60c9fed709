"""Suite `policy` with `--policy.type`: a policy's control tick and its training step, with the limits set for them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.utils import preprocess_observation
from lerobot.policies.factory import get_policy_class
from torch import Tensor, nn

from lerobot_policy_symview.chunks import ChunkPolicy
from lerobot_policy_symview.configuration_chunks import ChunkConfig
from lerobot_policy_symview.equivariance import checked_group, equivariance_errors, example_observation, is_exact
from lerobot_policy_symview.inputs.history import as_history
from lerobot_policy_symview.processor_pipelines import make_processors
from lerobot_policy_symview.rl.rollouts import metric_depth
from lerobot_symview import keys
from lerobot_symview.geometry.placement import CameraSpec
from symview_eval.benchmarks.clock import Clock, medians, seconds
from symview_sim.settings import EnvSettings

ROWS, COLUMNS = 480, 640  # pixels of the camera: VGA, as robots have
FRAMES = 24  # of the episode that is seen again and again
WARM_UP = 2  # chunks
CLIP = 10.0  # largest norm of the gradient, LeRobot's default for Adam
TRAIN_STEP_LIMIT = 1.3
CHANGE = 0.05  # standard deviation of random weights


class Limit(NamedTuple):
    """Longest tick of a size of the network: 10 Hz shall hold.

    Args:
        milliseconds: longest tick that predicts a chunk.
        cores: CPU cores that it may take.
    """

    milliseconds: float
    cores: int


LIMITS = {(16, 64): Limit(25.0, 1), (64, 128): Limit(120.0, 2)}
"""(Width, size of the crop) of the scales `laptop` and `paper` -> the limit of a tick."""


def benchmark_ticks(config: ChunkConfig, batch_size: int, repeats: int) -> dict[str, float]:
    """Time the ticks and the training step of an untrained policy. A size with a limit gets its number of cores.

    Args:
        config: the policy's configuration.
        batch_size: samples of a training step.
        repeats: timed training steps; ten times as many chunks are predicted.

    Returns:
        `tick_ms`: a tick that predicts a chunk, from the camera's RGBD to the action, for one robot: a median;
        `tick_limit_ms`, where this size has a limit. `tick_cpu_ms`: its CPU time, which a busy machine changes less.
        `view_ms`, `encoder_ms`, `head_ms` and `other_ms`: its parts. `tick_mean_ms`: the mean of all ticks, of which
        one in n_action_steps predicts. `train_step_s` and `encoder_step_s`: a training step of the policy, and of its
        encoder alone on the same images; `train_step_ratio_encoder`: the first over the second;
        `train_step_limit_encoder`: the limit. `equivariance_error`: the largest one, with random weights. `cores`:
        threads of PyTorch.
    """
    limit = LIMITS.get((config.width, config.crop_size))
    threads = torch.get_num_threads()
    if limit is not None and config.device == "cpu":
        torch.set_num_threads(limit.cores)
    try:
        policy = make_chunk_policy(config)
        results = {
            **_ticks(policy, 10 * repeats),
            **_training(policy, batch_size, repeats),
            "equivariance_error": _equivariance_error(policy),
            "cores": float(torch.get_num_threads()),
        }
    finally:
        torch.set_num_threads(threads)
    return results if limit is None else {"tick_limit_ms": limit.milliseconds} | results


def make_chunk_policy(config: ChunkConfig) -> ChunkPolicy:
    """Return an untrained policy of a configuration."""
    config.output_features = {keys.ACTION: PolicyFeature(FeatureType.ACTION, (len(config.action_symmetry),))}
    kind: Any = get_policy_class(config.type)
    policy: ChunkPolicy = kind(config).to(config.device)
    return policy


def _ticks(policy: ChunkPolicy, chunks: int) -> dict[str, float]:
    """Return the times of ticks, milliseconds."""
    config, network = policy.config, policy.averaged or policy.network
    preprocess, postprocess = make_processors(config, depth_units=metric_depth(config))
    observations = _observations(config)
    clocks = {"encoder_ms": Clock(network.encoder, "forward"), "head_ms": Clock(network.head, "forward")}
    ticks, predicting = [], []
    policy.reset()
    for tick in range((WARM_UP + chunks) * config.n_action_steps):
        before = {name: clock.milliseconds for name, clock in clocks.items()}
        raw = observations[tick % len(observations)]
        batch: dict[str, Tensor] = {}
        cpu = time.process_time()
        view = 1000 * seconds(lambda raw=raw, batch=batch: batch.update(preprocess(dict(raw))))  # type: ignore[misc]
        act = 1000 * seconds(lambda batch=batch: postprocess(policy.select_action(batch)))  # type: ignore[misc]
        cpu = 1000 * (time.process_time() - cpu)
        if tick >= WARM_UP * config.n_action_steps:
            ticks.append(view + act)
            if tick % config.n_action_steps == 0:
                parts = {name: clock.milliseconds - before[name] for name, clock in clocks.items()}
                predicting.append({"tick_ms": view + act, "tick_cpu_ms": cpu, "view_ms": view} | parts)
    for clock in clocks.values():
        clock.remove()
    times = {name: statistics.median(tick[name] for tick in predicting) for name in predicting[0]}
    other = times["tick_ms"] - times["view_ms"] - times["encoder_ms"] - times["head_ms"]
    return times | {"other_ms": other, "tick_mean_ms": statistics.fmean(ticks)}


def _observations(config: ChunkConfig) -> list[dict[str, Tensor]]:
    """Return successive observations of one robot, a batch of 1 each, as `lerobot-eval` gives them to policies."""
    camera = CameraSpec(config.camera, height=ROWS, width=COLUMNS)
    if config.wrist_camera not in (None, keys.WRIST):
        raise ValueError(
            f"--policy.wrist_camera={config.wrist_camera} is not simulated; the simulator's is {keys.WRIST}"
        )
    oracle, wrist = config.seen_camera == keys.ORACLE, config.wrist_camera is not None
    env = EnvSettings(camera=camera, oracle=oracle, wrist_camera=wrist, control="fine").make()
    observation, _ = env.reset(seed=0)
    observations = []
    for _ in range(FRAMES):
        batch = {name: value[None] for name, value in observation.items() if name != "pixels"}
        observations.append(preprocess_observation(batch | {"pixels": observation["pixels"]}))
        observation, *_ = env.step(env.expert_action())
    env.close()
    return observations


def _training(policy: ChunkPolicy, batch_size: int, repeats: int) -> dict[str, float]:
    """Return the seconds of training steps of the policy and of its encoder alone, and their ratio to the limit."""
    config, generator = policy.config, torch.Generator().manual_seed(0)
    frames = _frames(policy, batch_size * config.n_obs_steps)
    actions = torch.randn(batch_size, config.horizon, len(config.action_symmetry), generator=generator)
    batch = as_history(frames, config.n_obs_steps) if config.n_obs_steps > 1 else frames
    batch = batch | {keys.ACTION: 0.02 * actions.to(config.device)}
    with torch.no_grad():
        images, state = policy.network_input(frames)

    def whole_step() -> Tensor:
        return policy.forward(batch)[0]

    def encoder_step() -> Tensor:
        features: Tensor = policy.network.encoder(images, state)
        return features.float().square().mean()

    calls = {
        "train_step_s": _step(policy, policy.network, whole_step, policy.update),
        "encoder_step_s": _step(policy, policy.network.encoder, encoder_step),
    }
    times = medians(calls, repeats, "training step")
    ratio = times["train_step_s"] / times["encoder_step_s"]
    return times | {"train_step_ratio_encoder": ratio, "train_step_limit_encoder": TRAIN_STEP_LIMIT}


def _step(
    policy: ChunkPolicy, network: nn.Module, loss: Callable[[], Tensor], update: Callable[[], None] | None = None
) -> Callable[[], None]:
    """Return a training step as `lerobot-train` takes it."""
    parameters = list(network.parameters())
    optimizer = torch.optim.Adam(parameters, lr=policy.config.learning_rate)

    def step() -> None:
        policy.train()
        with policy.precision():
            error = loss()
        error.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(parameters, CLIP)
        optimizer.step()
        optimizer.zero_grad()
        if update is not None:
            update()

    return step


def _frames(policy: ChunkPolicy, count: int) -> dict[str, Tensor]:
    """Return observations as LeRobot's loader and the preprocessor deliver them: views of the size for crops."""
    config = policy.config
    frames = example_observation(config, batch=count)
    for key in filter(None, (config.color_key, config.height_key)):
        if key in frames:
            frames[key] = policy.scene.downscale(frames[key])
    return {name: values.to(config.device) for name, values in frames.items()}


def _equivariance_error(policy: ChunkPolicy) -> float:
    """Return the largest error over the group elements that map pixels onto pixels, after a change of the weights.

    At initialisation the chunks of flow matching are zero, which is trivially equivariant.
    """
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in (policy.averaged or policy.network).parameters():
            parameter.add_(CHANGE * torch.randn(parameter.shape, generator=generator).to(parameter))
    group = checked_group(policy.config)
    errors = equivariance_errors(policy)
    return max(error for element, error in errors.items() if is_exact(group, element))
