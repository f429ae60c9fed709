"""`symview-train-rl`: soft actor-critic from demonstrations, beside simulators."""

from __future__ import annotations

import logging
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from lerobot_policy_symview.rl.checkpoints import describe, last_checkpoint, push_policy, restore, save_checkpoint
from lerobot_policy_symview.rl.demonstrations import open_dataset
from lerobot_policy_symview.rl.learner import MEASURES
from lerobot_policy_symview.rl.records import Records
from lerobot_policy_symview.rl.train_config import TrainRlConfig
from lerobot_policy_symview.rl.training import Interval, Training
from lerobot_symview.runtime.cli import run_command

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-train-rl --env.task=block_picking --policy.method=reproj_equi --dataset.root=data/picking
  symview-train-rl --dataset.root=data/picking --policy.method=sideview_nonequi --output_dir=outputs/sideview
  symview-train-rl --dataset.root=data/picking --policy.width=16 --policy.crop_size=64 --batch_size=32
  symview-train-rl --dataset.root=data/picking --resume=true
  symview-train-rl --dataset.root=data/picking --policy.repo_id=me/picker"""


def train_rl(config: TrainRlConfig) -> Path:
    """Run or go on with the training that `config` describes, and return its last checkpoint.

    Raises:
        CommandError: if there is no dataset, or the output folder does not fit.
        KeyboardInterrupt: after a checkpoint was saved, if Ctrl-C was pressed.
    """
    begun = last_checkpoint(config)
    description = describe(config)
    with Training(config, open_dataset(config.dataset)) as training, _interruptions() as interruptions:
        run_id = config.wandb.run_id
        if begun:
            run_id = restore(training, begun) or run_id
        else:
            training.begin()
        _tell(training)
        with Records(config, training.step, run_id, description) as records:
            checkpoint, saved = begun, training.step if begun else None
            while training.step < config.steps and not interruptions:
                training.joint_step()
                records.advance()
                is_last = training.step == config.steps
                if training.step % config.log_every == 0 or is_last:
                    records.training(training.step, training.interval.row(MEASURES))
                    training.interval = Interval()
                if training.step % config.eval_every == 0 or is_last:
                    found = training.evaluate()
                    records.evaluation(training.step, {"success": found.success_rate, "return": found.mean_return})
                if training.step % config.save_every == 0:
                    checkpoint, saved = save_checkpoint(training, records.run_id), training.step
            if checkpoint is None or saved != training.step:
                checkpoint = save_checkpoint(training, records.run_id)
        if config.policy.push_to_hub and config.policy.repo_id and not interruptions:
            push_policy(training, checkpoint)
    if interruptions:
        logger.info("stopped at step %d: the same command with --resume=true goes on from there", training.step)
        raise KeyboardInterrupt
    logger.info("the policy is in %s", checkpoint / "pretrained_model")
    return checkpoint


def _tell(training: Training) -> None:
    replay = training.replay
    logger.info(
        "%d demonstrated transitions; %.1f kB for each transition, %.2f GB %s for all",
        len(replay),
        replay.bytes_per_transition / 1e3,
        replay.bytes_per_transition * replay.slots / 1e9,
        "on disk" if replay.is_on_disk else "of memory",
    )


@contextmanager
def _interruptions() -> Iterator[list[int]]:
    """Yield a list that Ctrl-C adds to instead of ending the process at once; a second one does that."""
    caught: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        caught.append(number)
        signal.signal(signal.SIGINT, previous)
        logger.info("finishing the step and saving; press Ctrl-C again to stop at once")

    previous = signal.signal(signal.SIGINT, note)
    try:
        yield caught
    finally:
        signal.signal(signal.SIGINT, previous)


def main() -> None:
    """Run the console command."""
    run_command(TrainRlConfig, train_rl, EXAMPLES)
