"""Behaviour cloning with the demonstrations in memory, and evaluation in simulators, if possible in parallel."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import torch
from accelerate import Accelerator
from lerobot.scripts.lerobot_train import update_policy
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker
from lerobot.utils.random_utils import set_seed

from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.rl.rollouts import EVALUATION_SEED, Actor, Evaluation, evaluate, simulator_config
from symview_eval.experiments.actors import make_actor
from symview_eval.experiments.demonstrations import Demonstrations
from symview_eval.experiments.grid import Cell
from symview_eval.experiments.results import Checkpoint, Times, checkpoint
from symview_sim.settings import WorldSettings
from symview_sim.simulators import Simulators


@dataclass(frozen=True)
class CloningResult:
    """Evaluations, policy and times of a training."""

    checkpoints: list[Checkpoint]
    actor: Actor
    times: Times


class Evaluator:
    """Evaluates copies of a policy in a thread, one after the other, while its training may continue.

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

    def submit(self, actor: Actor) -> Future[Evaluation]:
        """Evaluate a copy of a policy with its present weights. Wait for the result if the policy remembers."""
        seeds = range(self._next_seed, self._next_seed + self._episodes)
        self._next_seed += self._episodes
        return self._thread.submit(self._evaluate, actor.copy(), seeds)

    def _evaluate(self, actor: Actor, seeds: Sequence[int]) -> Evaluation:
        start = time.perf_counter()
        evaluation = evaluate(actor, self._simulators, seeds, self._discount)
        self.seconds += time.perf_counter() - start
        return evaluation


def run_cloning(cell: Cell, dataset: Any, env: WorldSettings, device: str) -> CloningResult:
    """Train a cell's policy with LeRobot's own update, and evaluate it at every checkpoint.

    Evaluations run while the training continues, unless the policy remembers.

    Args:
        cell: the cell.
        dataset: `LeRobotDataset` of its demonstrations.
        env: environment of the evaluations.
        device: PyTorch device of the network.
    """
    scale = cell.scale
    begin, begin_cpu = time.perf_counter(), time.process_time()
    set_seed(cell.seed)
    actor = make_actor(cell, dataset, device)
    policy, config = actor.policy, actor.policy.config
    batches = Demonstrations(dataset, actor).batches(cell.batch_size, cell.seed)
    preset = config.get_optimizer_preset()
    optimizer: Any = preset.build(policy.get_optim_params())
    schedule = config.get_scheduler_preset()
    scheduler = schedule.build(optimizer, cell.steps) if schedule is not None else None
    accelerator = Accelerator(cpu=device == "cpu")
    first_seed = EVALUATION_SEED + cell.seed * scale.evaluations * scale.eval_episodes
    pending: list[tuple[int, float, Future[Evaluation]]] = []
    with (
        Simulators(simulator_config(actor.scene.config, env), scale.simulators) as simulators,
        Evaluator(simulators, scale.eval_episodes, first_seed, SymviewSacfdConfig.discount) as evaluator,
    ):
        metrics = _metrics(cell.batch_size)
        ready, waiting_s = time.perf_counter(), 0.0
        for step in range(1, cell.steps + 1):
            update_policy(metrics, policy, next(batches), optimizer, preset.grad_clip_norm, accelerator, scheduler)
            if step % cell.eval_every == 0:
                pending.append((step, metrics.loss.avg, evaluator.submit(actor)))
                metrics.reset_averages()
                if actor.remembers:  # its evaluation draws from the random numbers that the training draws from
                    waiting_s += _wait(pending[-1][2])
        trained = time.perf_counter()
        checkpoints = [checkpoint(step, evaluation.result(), loss) for step, loss, evaluation in pending]
        times = Times(
            preparation_s=ready - begin,
            training_s=trained - ready - waiting_s,
            waiting_s=time.perf_counter() - trained + waiting_s,
            evaluation_s=evaluator.seconds,
            cpu_s=time.process_time() - begin_cpu + simulators.cpu_seconds(),
        )
        return CloningResult(checkpoints, actor, times)


def _wait(evaluation: Future[Evaluation]) -> float:
    """Wait for an evaluation; return the seconds."""
    start = time.perf_counter()
    evaluation.result()
    return time.perf_counter() - start


def _metrics(batch_size: int) -> Any:
    """Return the tracker that LeRobot's update writes its metrics into."""
    meters = {name: AverageMeter(name, ":.3f") for name in ("loss", "grad_norm", "lr", "update_s", "gpu_mem_gb")}
    return MetricsTracker(batch_size, 1, 1, meters)
