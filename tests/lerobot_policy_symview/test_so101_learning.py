"""The path of docs/own_robot.md at full size: a policy learns from joints and lifts cubes with joints."""

import sys

import pytest
from lerobot.scripts import lerobot_train

from tests.helpers.so101 import convert, load_example, record, view


@pytest.mark.learning
@pytest.mark.usefixtures("unchecked_kernels")
def test_a_policy_learns_from_joints_to_lift_cubes_with_joints(tmp_path, monkeypatch):
    """docs/own_robot.md has the measured success rates."""
    views = view(convert(record(monkeypatch, tmp_path / "joints", episodes=80)))
    command = [
        "lerobot-train",
        "--dataset.repo_id=test/views",
        f"--dataset.root={views}",
        "--policy.type=symview_bc",
        "--policy.width=16",
        "--policy.crop_size=64",
        "--policy.learning_rate_decay=cosine",
        "--policy.aperture_noise=0.03",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--steps=1500",
        "--batch_size=16",
        "--num_workers=0",
        "--env_eval_freq=0",
        "--seed=0",
        f"--output_dir={tmp_path / 'run'}",
    ]
    monkeypatch.setattr(sys, "argv", command)
    lerobot_train.main()
    policy = str(tmp_path / "run" / "checkpoints" / "last" / "pretrained_model")
    solved = load_example("so101_rollouts")["main"](policy, scenes=50, seed=200_000, seconds=6.0)
    assert solved >= 35
