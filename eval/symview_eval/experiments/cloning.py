"""Behaviour cloning with the demonstrations in memory, and evaluation in simulators, if possible in parallel."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from accelerate import Accelerator
from lerobot.scripts.lerobot_train import update_policy
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker
from lerobot.utils.random_utils import set_seed
from tqdm import tqdm

from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.rl.rollouts import EVALUATION_SEED, Actor, simulator_config
from symview_eval.experiments.actors import make_actor
from symview_eval.experiments.demonstrations import Demonstrations
from symview_eval.experiments.evaluator import Evaluator
from symview_eval.experiments.grid import Cell
from symview_eval.experiments.results import Checkpoint, Times
from symview_eval.experiments.training_state import Checkpoints, Learner
from symview_sim.settings import WorldSettings
from symview_sim.simulators import Simulators

logger = logging.getLogger(__name__)

NO_TIMES = Times(0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class CloningResult:
    """Evaluations, policy and times of a training."""

    evaluations: list[Checkpoint]
    actor: Actor
    times: Times
    """Those of the runs that it continues included, up to their last checkpoints."""
    earlier_s: float
    """Wall-clock time of the runs that it continues."""


def run_cloning(cell: Cell, dataset: Any, env: WorldSettings, device: str, saved: Checkpoints) -> CloningResult:
    """Train a cell's policy with LeRobot's own update, and evaluate it after equal numbers of steps.

    Evaluations run while the training continues, unless the policy remembers. A training that was killed continues from
    its last checkpoint; on a CPU its weights and evaluations are bit-identical to those of an uninterrupted one.

    Args:
        cell: the cell.
        dataset: `LeRobotDataset` of its demonstrations.
        env: environment of the evaluations.
        device: PyTorch device of the network.
        saved: its checkpoints, which remain at the end.
    """
    scale = cell.scale
    begin, begin_cpu = time.perf_counter(), time.process_time()
    set_seed(cell.seed)
    actor = make_actor(cell, dataset, device)
    policy, config = actor.policy, actor.policy.config
    demonstrations = Demonstrations(dataset, actor)
    preset = config.get_optimizer_preset()
    optimizer: Any = preset.build(policy.get_optim_params())
    schedule = config.get_scheduler_preset()
    scheduler = schedule.build(optimizer, cell.steps) if schedule is not None else None
    learner = Learner(policy, optimizer, scheduler)
    accelerator = Accelerator(cpu=device == "cpu")
    metrics = _metrics(cell.batch_size)
    first_seed = EVALUATION_SEED + cell.seed * scale.evaluations * scale.eval_episodes
    with (
        Simulators(simulator_config(actor.scene.config, env), scale.simulators) as simulators,
        Evaluator(simulators, scale.eval_episodes, first_seed, SymviewSacfdConfig.discount) as evaluator,
    ):
        start, earlier = 0, NO_TIMES
        if last := saved.last():
            folder, content = last
            start, earlier = content["step"], Times(**content["times"])
            evaluator.load(folder, content["evaluations"], actor)
            vars(metrics.loss).update(content["loss"])
            learner.load(folder)
            logger.info("%s resumes after step %d of %d", cell, start, cell.steps)
        batches = demonstrations.batches(cell.batch_size, cell.seed, start)
        ready = time.perf_counter()

        def times() -> Times:
            return earlier + Times(
                preparation_s=ready - begin,
                training_s=time.perf_counter() - ready - evaluator.waiting_s,
                waiting_s=evaluator.waiting_s,
                evaluation_s=evaluator.seconds,
                cpu_s=time.process_time() - begin_cpu + simulators.cpu_seconds(),
            )

        def save(folder: Path) -> dict[str, Any]:
            learner.save(folder)
            evaluations = evaluator.save(folder)
            return {"evaluations": evaluations, "loss": vars(metrics.loss), "times": asdict(times())}

        # ten seconds between updates, as the log of a queue keeps every one
        with tqdm(desc="training", initial=start, total=cell.steps, unit="step", leave=False, mininterval=10) as bar:
            for step in range(start + 1, cell.steps + 1):
                update_policy(metrics, policy, next(batches), optimizer, preset.grad_clip_norm, accelerator, scheduler)
                if step % cell.eval_every == 0:
                    evaluator.submit(actor, step, metrics.loss.avg)
                    metrics.reset_averages()
                if saved.is_due:
                    saved.write(step, save)
                bar.update()
        return CloningResult(evaluator.results(), actor, times(), earlier.wall_clock_s)


def _metrics(batch_size: int) -> Any:
    """Return the tracker that LeRobot's update writes its metrics into."""
    meters = {name: AverageMeter(name, ":.3f") for name in ("loss", "grad_norm", "lr", "update_s", "gpu_mem_gb")}
    return MetricsTracker(batch_size, 1, 1, meters)
