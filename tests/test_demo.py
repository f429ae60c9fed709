"""The demo at full size: 20 demonstrations suffice for the equivariant policy, not for the plain one."""

import sys
from functools import cache

import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.scripts import lerobot_eval, lerobot_train

from symview_eval.demo import REPO_ID, DemoConfig, demo, evaluate_command, train_command
from symview_eval.demo_report import read_success


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked_kernels")
def test_equivariant_policy_learns_from_twenty_demonstrations_and_plain_policy_does_not(tmp_path, monkeypatch):
    """With the same demonstrations, steps and episodes; docs/policies.md has the measured success rates."""
    config = DemoConfig(output_dir=tmp_path)
    demo(config)
    equivariant, moved = (read_success(tmp_path / name) for name in ("evaluation", "evaluation_moved"))
    policy, evaluation = tmp_path / "sideview", tmp_path / "sideview_evaluation"
    train = train_command(config, REPO_ID, tmp_path / "recorded", policy, "--policy.method=sideview_nonequi")
    evaluate = evaluate_command(config, policy, evaluation)
    # LeRobot decodes a frame at each of its 130 uses, which takes three times as long as the updates.
    monkeypatch.setattr(LeRobotDataset, "__getitem__", cache(LeRobotDataset.__getitem__))
    for command, main in ((train, lerobot_train.main), (evaluate, lerobot_eval.main)):
        monkeypatch.setattr(sys, "argv", list(command))
        main()
    plain = read_success(evaluation)
    assert equivariant.episodes == moved.episodes == plain.episodes == 50
    assert equivariant.rate >= 0.8
    assert equivariant.rate >= plain.rate + 0.2
    assert moved.rate >= 0.5  # the camera stands elsewhere than in every demonstration
