"""Behaviour cloning with the demonstrations in memory, and evaluation in simulators in parallel with the training."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from accelerate import Accelerator
from lerobot.policies import make_policy
from lerobot.scripts.lerobot_train import update_policy
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker
from lerobot.utils.random_utils import set_seed
from torch import Tensor

from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.inputs.observation_codec import ObservationCodec
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.rl.demonstrations import observations
from lerobot_policy_symview.rl.rollouts import EVALUATION_SEED, Actor, Evaluation, evaluate, simulator_config
from lerobot_symview import keys
from symview_eval.experiments.grid import Cell
from symview_eval.experiments.results import Checkpoint, Times, checkpoint
from symview_sim.settings import WorldSettings
from symview_sim.simulators import Simulators

AUGMENTED_VARIANTS = 16  # of every frame, with camera augmentation; LeRobot's training makes a new one each time


@dataclass(frozen=True)
class CloningResult:
    """Evaluations, policy and times of a training."""

    checkpoints: list[Checkpoint]
    actor: Actor
    times: Times


class Demonstrations:
    """A dataset's inputs of a policy's network and its actions, on the policy's device.

    Args:
        dataset: a `LeRobotDataset` with the camera's images.
        actor: the policy; its preprocessor, which renders the view, runs once per frame, or with camera augmentation as
            often as there are variants.
    """

    def __init__(self, dataset: Any, actor: Actor):
        self._device = torch.device(actor.policy.config.device)
        self._codec = ObservationCodec(actor.policy.scene)
        frames, actions = [], []
        for _ in range(AUGMENTED_VARIANTS if actor.policy.config.camera_augmentation else 1):
            for observation, action in observations(dataset):
                # with actions, as in training: the preprocessor augments observations that have some
                frames += self._codec.pack(actor.preprocessor(observation | {keys.ACTION: action}))
                actions.append(action)
        self._frames = {
            name: torch.stack([torch.from_numpy(frame[name]) for frame in frames]).to(self._device)
            for name in frames[0]
        }
        self._actions = torch.cat(actions).to(self._device)

    def batches(self, size: int, seed: int) -> Iterator[dict[str, Tensor]]:
        """Yield batches of `size` frames without end; each pass visits every frame once in random order."""
        generator = torch.Generator().manual_seed(seed)
        order = torch.empty(0, dtype=torch.long)
        while True:
            while len(order) < size:
                order = torch.cat([order, torch.randperm(len(self._actions), generator=generator)])
            chosen, order = order[:size].to(self._device), order[size:]
            batch = self._codec.unpack({name: values[chosen] for name, values in self._frames.items()}, self._device)
            yield batch | {keys.ACTION: self._actions[chosen]}


class Evaluator:
    """Evaluates copies of a policy in a thread, one after the other, while its training continues.

    Args:
        simulators: the simulators that run the episodes.
        episodes: episodes per evaluation.
        first_seed: seed of the first scene; later scenes and evaluations have the following seeds.
        discount: discount factor of the returns.
    """

    def __init__(self, simulators: Simulators, episodes: int, first_seed: int, discount: float):
        self._simulators, self._episodes, self._next_seed, self._discount = simulators, episodes, first_seed, discount
        threads = torch.get_num_threads()
        self._thread = ThreadPoolExecutor(1, "evaluation", initializer=torch.set_num_threads, initargs=(threads,))
        self.seconds = 0.0

    def __enter__(self) -> Evaluator:
        return self

    def __exit__(self, *error: object) -> None:
        self._thread.shutdown(cancel_futures=True)

    def submit(self, policy: SymviewBcPolicy) -> Future[Evaluation]:
        """Evaluate a copy of a policy with its present weights."""
        seeds = range(self._next_seed, self._next_seed + self._episodes)
        self._next_seed += self._episodes
        return self._thread.submit(self._evaluate, Actor(deepcopy(policy)), seeds)

    def _evaluate(self, actor: Actor, seeds: Sequence[int]) -> Evaluation:
        start = time.perf_counter()
        evaluation = evaluate(actor, self._simulators, seeds, self._discount)
        self.seconds += time.perf_counter() - start
        return evaluation


def policy_config(cell: Cell, device: str) -> SymviewBcConfig:
    """Return the configuration of a cell's policy."""
    config = SymviewBcConfig(
        device=device,
        push_to_hub=False,
        **cell.scale.policy(cell.algorithm),
        **cell.row.policy_options,
    )
    config.limit_view()
    return config


def run_cloning(cell: Cell, dataset: Any, env: WorldSettings, device: str) -> CloningResult:
    """Train a cell's policy with LeRobot's own update, and evaluate it at every checkpoint.

    Args:
        cell: the cell.
        dataset: `LeRobotDataset` of its demonstrations.
        env: environment of the evaluations.
        device: PyTorch device of the network.
    """
    scale = cell.scale
    begin, begin_cpu = time.perf_counter(), time.process_time()
    set_seed(cell.seed)
    config = policy_config(cell, device)
    policy: Any = make_policy(config, ds_meta=dataset.meta)
    actor = Actor(policy)
    batches = Demonstrations(dataset, actor).batches(scale.batch_size, cell.seed)
    preset = config.get_optimizer_preset()
    optimizer: Any = preset.build(policy.get_optim_params())
    schedule = config.get_scheduler_preset()
    scheduler = schedule.build(optimizer, cell.steps) if schedule is not None else None
    accelerator = Accelerator(cpu=device == "cpu")
    first_seed = EVALUATION_SEED + cell.seed * scale.evaluations * scale.eval_episodes
    pending: list[tuple[int, float, Future[Evaluation]]] = []
    with (
        Simulators(simulator_config(config, env), scale.simulators) as simulators,
        Evaluator(simulators, scale.eval_episodes, first_seed, SymviewSacfdConfig.discount) as evaluator,
    ):
        metrics = _metrics(scale.batch_size)
        ready = time.perf_counter()
        for step in range(1, cell.steps + 1):
            update_policy(metrics, policy, next(batches), optimizer, preset.grad_clip_norm, accelerator, scheduler)
            if step % cell.eval_every == 0:
                pending.append((step, metrics.loss.avg, evaluator.submit(policy)))
                metrics.reset_averages()
        trained = time.perf_counter()
        checkpoints = [checkpoint(step, evaluation.result(), loss) for step, loss, evaluation in pending]
        times = Times(
            preparation_s=ready - begin,
            training_s=trained - ready,
            waiting_s=time.perf_counter() - trained,
            evaluation_s=evaluator.seconds,
            cpu_s=time.process_time() - begin_cpu + simulators.cpu_seconds(),
        )
        return CloningResult(checkpoints, actor, times)


def _metrics(batch_size: int) -> Any:
    """Return the tracker that LeRobot's update writes its metrics into."""
    meters = {name: AverageMeter(name, ":.3f") for name in ("loss", "grad_norm", "lr", "update_s", "gpu_mem_gb")}
    return MetricsTracker(batch_size, 1, 1, meters)
