"""Checkpoints in LeRobot's layout: a policy that LeRobot's commands load, and the state of the training."""

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
from lerobot_policy_symview.rl.metrics import MetricsWindow, read_table
from lerobot_policy_symview.rl.train_config import TrainRlConfig
from lerobot_policy_symview.rl.training import RunningEpisode, Training
from lerobot_symview.datasets.hub import hub_errors
from lerobot_symview.runtime.cli import CommandError
from lerobot_symview.runtime.staging import part_of

logger = logging.getLogger(__name__)

CONFIGURATION, STATE, REPLAY = "train_config.json", "state.json", "replay"
MAY_DIFFER = ("resume", "wandb", "output_dir")  # flags that may change when a run is resumed


def save_checkpoint(training: Training, run_id: str | None) -> Path:
    """Write a checkpoint atomically, and delete the replay buffers of earlier checkpoints.

    Raises:
        DivergenceError: if a weight is not finite; the earlier checkpoints are kept unchanged.
    """
    training.learner.check_weights()
    folder = get_step_checkpoint_dir(training.config.output_dir, training.config.steps, training.step)
    part = part_of(folder)
    model, state = part / PRETRAINED_MODEL_DIR, part / TRAINING_STATE_DIR
    state.mkdir(parents=True)
    for component in (training.policy, training.actor.preprocessor, training.actor.postprocessor):
        component.save_pretrained(model)
    (model / CONFIGURATION).write_text(json.dumps(describe(training.config), indent=4))
    training.learner.save(state)
    save_rng_state(state)
    training.replay.save(state / REPLAY)
    content = {
        "step": training.step,
        "episodes": [
            {
                "seed": episode.seed,
                "actions": [action.tolist() for action in episode.actions],
                "return": episode.discounted_return,
            }
            for episode in training.episodes
        ],
        "episodes_started": training.episodes_started,
        "window": training.window.to_json(),
        "rng": training.rng.bit_generator.state,
        "cpu_s": training.cpu_s,
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
    """Push a checkpoint's policy and its model card to the Hub.

    Raises:
        CommandError: if that fails; the checkpoint is kept unchanged.
    """
    config, run = training.policy.config, training.config
    facts = {
        "updates": training.step,
        "batch size": run.batch_size,
        "simulators": run.num_simulators,
        "seed": run.seed,
    }
    evaluation = run.output_dir / "evaluation.csv"
    rows = read_table(evaluation) if evaluation.exists() else []
    card = model_card(config, training.policy.parameter_count, run.dataset.repo_id, facts, rows, config.tags or ())
    model = checkpoint / PRETRAINED_MODEL_DIR
    card.save(model / "README.md")
    with hub_errors(config.repo_id, "--policy.repo_id", model):
        card.validate()
        api = HfApi()
        address = api.create_repo(config.repo_id, private=config.private, exist_ok=True)
        api.upload_folder(repo_id=config.repo_id, folder_path=model)
    logger.info("pushed to %s", address)


def restore(training: Training, folder: Path) -> str | None:
    """Restore a training from a checkpoint; return the run's identifier at Weights & Biases."""
    model, state = folder / PRETRAINED_MODEL_DIR, folder / TRAINING_STATE_DIR
    content = json.loads((state / STATE).read_text())
    load_model(training.policy, model / "model.safetensors")
    training.learner.load(state)
    training.replay.load(state / REPLAY)
    training.step, training.episodes_started = content["step"], content["episodes_started"]
    training.episodes = [
        RunningEpisode(
            episode["seed"], [np.array(action, np.float32) for action in episode["actions"]], episode["return"]
        )
        for episode in content["episodes"]
    ]
    training.window = MetricsWindow(**content["window"])
    training.rng.bit_generator.state = content["rng"]
    training.earlier_cpu_s = content["cpu_s"]
    training.restore_simulators()
    load_rng_state(state)
    run_id: str | None = content["wandb_run_id"]
    return run_id


def cpu_seconds(folder: Path) -> float:
    """Return the CPU time of a run up to a checkpoint, simulators included."""
    return float(json.loads((folder / TRAINING_STATE_DIR / STATE).read_text())["cpu_s"])


def last_checkpoint(config: TrainRlConfig) -> Path | None:
    """Return the checkpoint to resume from, None for a new run.

    Raises:
        CommandError: if the folder has a run and `resume` is not set, has none to resume, or has one of other flags.
    """
    checkpoints = config.output_dir / CHECKPOINTS_DIR
    if not config.resume:
        if checkpoints.exists():
            raise CommandError(
                f"{config.output_dir} already has a run: use --resume=true to resume it, or another --output_dir"
            )
        return None
    last = checkpoints / LAST_CHECKPOINT_LINK
    if not last.exists():
        raise CommandError(f"there is no checkpoint in {config.output_dir} to resume from: leave out --resume=true")
    saved = json.loads((last / PRETRAINED_MODEL_DIR / CONFIGURATION).read_text())
    current = describe(config)
    names = sorted(name for name in saved.keys() | current.keys() if name.split(".")[0] not in MAY_DIFFER)
    differing = [name for name in names if saved.get(name) != current.get(name)]
    if differing:
        flags = "; ".join(f"--{name} is {current.get(name)!r}, was {saved.get(name)!r}" for name in differing)
        raise CommandError(f"the run in {config.output_dir} was started with other flags: {flags}")
    return last.resolve()


def describe(config: TrainRlConfig) -> dict[str, Any]:
    """Return the configuration as a flat mapping from dotted flags to values, as JSON stores them."""
    return _flattened(json.loads(json.dumps(draccus.encode(config))))


def _flattened(content: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in content.items():
        nested = isinstance(value, dict) and value
        flat |= _flattened(value, f"{prefix}{name}.") if nested else {prefix + name: value}
    return flat
