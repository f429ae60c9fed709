"""Checkpoints as LeRobot lays them out: a policy that anything of LeRobot's loads, and what it takes to go on."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path
from typing import Any

import draccus
import numpy as np
from huggingface_hub import HfApi
from lerobot.common.train_utils import get_step_checkpoint_dir, update_last_checkpoint
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    PRETRAINED_MODEL_DIR,
    TRAINING_STATE_DIR,
)
from lerobot.utils.random_utils import load_rng_state, save_rng_state
from safetensors.torch import load_model

from lerobot_policy_symview.model_card import model_card
from lerobot_policy_symview.rl.records import read_table
from lerobot_policy_symview.rl.train_config import TrainRlConfig
from lerobot_policy_symview.rl.training import Episode, Interval, Training
from lerobot_symview.datasets.hub import hub_errors
from lerobot_symview.runtime.cli import CommandError
from lerobot_symview.runtime.staging import part_of

logger = logging.getLogger(__name__)

CONFIGURATION, STATE, REPLAY = "train_config.json", "state.json", "replay"
FREE = ("resume", "wandb", "output_dir")  # what may differ when a run is resumed


def save_checkpoint(training: Training, run_id: str | None) -> Path:
    """Write a checkpoint, whole or not at all, and drop the replay of those before."""
    folder = get_step_checkpoint_dir(training.config.output_dir, training.config.steps, training.step)
    part = part_of(folder)
    model, state = part / PRETRAINED_MODEL_DIR, part / TRAINING_STATE_DIR
    state.mkdir(parents=True)
    for one in (training.policy, training.actor.preprocessor, training.actor.postprocessor):
        one.save_pretrained(model)
    (model / CONFIGURATION).write_text(json.dumps(describe(training.config), indent=4))
    training.learner.save(state)
    save_rng_state(state)
    training.replay.save(state / REPLAY)
    content = {
        "step": training.step,
        "episodes": [
            {"seed": one.seed, "actions": [action.tolist() for action in one.actions], "return": one.discounted_return}
            for one in training.episodes
        ],
        "episodes_begun": training.episodes_begun,
        "interval": training.interval.plain(),
        "rng": training.rng.bit_generator.state,
        "wandb_run_id": run_id,
    }
    (state / STATE).write_text(json.dumps(content))
    shutil.rmtree(folder, ignore_errors=True)
    part.rename(folder)
    update_last_checkpoint(folder)
    for older in folder.parent.glob(f"*/{TRAINING_STATE_DIR}/{REPLAY}"):
        if older.parent.parent.resolve() != folder.resolve():
            shutil.rmtree(older)
    return folder


def push_policy(training: Training, checkpoint: Path) -> None:
    """Upload a checkpoint's policy with its card to the Hub.

    Raises:
        CommandError: if that fails; the checkpoint stays as it is.
    """
    config, run = training.policy.config, training.config
    told = {"updates": training.step, "batches of": run.batch_size, "simulators": run.num_simulators, "seed": run.seed}
    evaluation = run.output_dir / "evaluation.csv"
    rows = read_table(evaluation) if evaluation.exists() else []
    card = model_card(config, training.policy.parameter_count, run.dataset.repo_id, told, rows, config.tags or ())
    model = checkpoint / PRETRAINED_MODEL_DIR
    card.save(model / "README.md")
    with hub_errors(config.repo_id, "--policy.repo_id", model):
        card.validate()
        api = HfApi()
        address = api.create_repo(config.repo_id, private=config.private, exist_ok=True)
        api.upload_folder(repo_id=config.repo_id, folder_path=model)
    logger.info("pushed to %s", address)


def restore(training: Training, folder: Path) -> str | None:
    """Take over what a checkpoint says; return the run's name at Weights & Biases."""
    model, state = folder / PRETRAINED_MODEL_DIR, folder / TRAINING_STATE_DIR
    content = json.loads((state / STATE).read_text())
    load_model(training.policy, model / "model.safetensors")
    training.learner.load(state)
    training.replay.load(state / REPLAY)
    training.step, training.episodes_begun = content["step"], content["episodes_begun"]
    training.episodes = [
        Episode(one["seed"], [np.array(action, np.float32) for action in one["actions"]], one["return"])
        for one in content["episodes"]
    ]
    training.interval = Interval(**content["interval"])
    training.rng.bit_generator.state = content["rng"]
    training.go_on()
    load_rng_state(state)
    run_id: str | None = content["wandb_run_id"]
    return run_id


def last_checkpoint(config: TrainRlConfig) -> Path | None:
    """Return the checkpoint to resume from, None for a new run.

    Raises:
        CommandError: if the folder holds a run that is not to be resumed, none although one is, or another run.
    """
    checkpoints = config.output_dir / CHECKPOINTS_DIR
    if not config.resume:
        if checkpoints.exists():
            raise CommandError(
                f"{config.output_dir} holds a training: use --resume=true to go on, or another --output_dir"
            )
        return None
    last = checkpoints / LAST_CHECKPOINT_LINK
    if not last.exists():
        raise CommandError(f"there is no checkpoint in {config.output_dir} to resume from: leave out --resume=true")
    stated = json.loads((last / PRETRAINED_MODEL_DIR / CONFIGURATION).read_text())
    asked = describe(config)
    names = sorted(name for name in stated.keys() | asked.keys() if name.split(".")[0] not in FREE)
    differing = [name for name in names if stated.get(name) != asked.get(name)]
    if differing:
        flags = "; ".join(f"--{name} is {asked.get(name)!r}, was {stated.get(name)!r}" for name in differing)
        raise CommandError(f"the training in {config.output_dir} was begun with other flags: {flags}")
    return last.resolve()


def describe(config: TrainRlConfig) -> dict[str, Any]:
    """Return the flags as JSON holds them, one entry for each."""
    return _flattened(json.loads(json.dumps(draccus.encode(config))))


def _flattened(content: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in content.items():
        nested = isinstance(value, dict) and value
        flat |= _flattened(value, f"{prefix}{name}.") if nested else {prefix + name: value}
    return flat
