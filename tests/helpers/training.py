"""LeRobot's training command, in process."""

import sys

from lerobot.scripts import lerobot_train

NEW = ("--policy.type=symview_bc", "--policy.width=16", "--policy.crop_size=64")


def train(monkeypatch, dataset, output, *options, policy=NEW):
    """Train a policy for two steps; return its folder. Later options override earlier ones."""
    command = [
        "lerobot-train",
        "--dataset.repo_id=test/recorded",
        f"--dataset.root={dataset}",
        *policy,
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--steps=2",
        "--batch_size=2",
        "--num_workers=0",
        "--env_eval_freq=0",
        f"--output_dir={output}",
        *options,
    ]
    monkeypatch.setattr(sys, "argv", command)
    lerobot_train.main()
    return output / "checkpoints" / "last" / "pretrained_model"
