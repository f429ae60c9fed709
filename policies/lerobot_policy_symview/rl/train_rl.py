"""`symview-train-rl`: soft actor-critic from demonstrations (SACfD) in parallel simulators."""

from __future__ import annotations

import logging
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK

from lerobot_policy_symview.rl.checkpoints import describe, last_checkpoint, push_policy, restore, save_checkpoint
from lerobot_policy_symview.rl.demonstrations import open_dataset
from lerobot_policy_symview.rl.learner import METRICS
from lerobot_policy_symview.rl.metrics import MetricsLogger, MetricsWindow
from lerobot_policy_symview.rl.train_config import TrainRlConfig
from lerobot_policy_symview.rl.training import Training
from lerobot_symview.errors import DivergenceError
from lerobot_symview.runtime.cli import flagged, run_command
from lerobot_symview.runtime.locking import RUN_LOCK, locked

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-train-rl --env.task=block_picking --policy.method=reproj_equi --dataset.root=data/picking
  symview-train-rl --dataset.root=data/picking --policy.method=sideview_nonequi --output_dir=outputs/sideview
  symview-train-rl --dataset.root=data/picking --policy.width=16 --policy.crop_size=64 --batch_size=32
  symview-train-rl --dataset.root=data/picking --resume=true
  symview-train-rl --dataset.root=data/picking --policy.repo_id=me/picker"""


def train_rl(config: TrainRlConfig) -> Path:
    """Run or resume a training, and return its last checkpoint.

    Raises:
        CommandError: if there is no dataset, the content of the output folder does not fit, or another run is writing
            to that folder.
        DivergenceError: if an action, the critic's loss or a weight is not finite; earlier checkpoints are kept.
        KeyboardInterrupt: if Ctrl-C was pressed, after saving a checkpoint.
    """
    with flagged("--dataset"):
        dataset = open_dataset(config.dataset)
    with locked(config.output_dir / RUN_LOCK, config.output_dir, "--output_dir"):
        return _train(config, dataset)


def _train(config: TrainRlConfig, dataset: Any) -> Path:
    last = last_checkpoint(config)
    description = describe(config)
    with Training(config, dataset) as training, _interruptions() as interruptions:
        run_id = config.wandb.run_id
        if last:
            run_id = restore(training, last) or run_id
        else:
            training.start()
        _log_replay_size(training)
        with MetricsLogger(config, training.step, run_id, description) as logs, _divergence_reported(training):
            checkpoint, saved_step = last, training.step if last else None
            while training.step < config.steps and not interruptions:
                training.joint_step()
                logs.advance()
                is_last = training.step == config.steps
                if training.step % config.log_every == 0 or is_last:
                    logs.log_training(training.step, training.window.averages(METRICS))
                    training.window = MetricsWindow()
                if training.step % config.eval_every == 0 or is_last:
                    evaluation = training.evaluate()
                    row = {"success": evaluation.success_rate, "return": evaluation.mean_return}
                    logs.log_evaluation(training.step, row)
                if training.step % config.save_every == 0:
                    checkpoint, saved_step = save_checkpoint(training, logs.run_id), training.step
            if checkpoint is None or saved_step != training.step:
                checkpoint = save_checkpoint(training, logs.run_id)
        if config.policy.push_to_hub and config.policy.repo_id and not interruptions:
            push_policy(training, checkpoint)
    if interruptions:
        logger.info("stopped at step %d; run the same command with --resume=true to resume", training.step)
        raise KeyboardInterrupt
    logger.info("the policy is in %s", checkpoint / "pretrained_model")
    return checkpoint


def _log_replay_size(training: Training) -> None:
    replay = training.replay
    logger.info(
        "replay buffer: %d demonstrated transitions; %.1f kB per transition, %.2f GB %s when full",
        len(replay),
        replay.bytes_per_transition / 1e3,
        replay.bytes_per_transition * replay.slots / 1e9,
        "on disk" if replay.is_on_disk else "of memory",
    )


@contextmanager
def _divergence_reported(training: Training) -> Iterator[None]:
    """Add the step, the last checkpoint and the remedy to the error of a training that has diverged."""
    try:
        yield
    except DivergenceError as error:
        last = training.config.output_dir / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK
        kept = f"the last checkpoint is {last.resolve()}" if last.exists() else "there is no checkpoint"
        raise DivergenceError(
            f"the training diverged after step {training.step}: {error}; {kept}: train again with a lower "
            "--policy.learning_rate"
        ) from None


@contextmanager
def _interruptions() -> Iterator[list[int]]:
    """Yield a list to which the first Ctrl-C is added instead of ending the process; the second one ends it."""
    caught: list[int] = []

    def catch(number: int, frame: FrameType | None) -> None:
        caught.append(number)
        signal.signal(signal.SIGINT, previous)
        logger.info("finishing the step and saving a checkpoint; press Ctrl-C again to stop at once")

    previous = signal.signal(signal.SIGINT, catch)
    try:
        yield caught
    finally:
        signal.signal(signal.SIGINT, previous)


def main() -> None:
    """Run the console command."""
    run_command(TrainRlConfig, train_rl, EXAMPLES)
