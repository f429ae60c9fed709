"""The demo at its full size: what a newcomer is promised, and what the paper is about."""

import sys

import pytest
from lerobot.scripts import lerobot_eval, lerobot_train

from symview_eval.demo import REPO_ID, DemoConfig, demo, evaluate_command, train_command
from symview_eval.demo_report import read_success


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked_kernels")
def test_twenty_demonstrations_suffice_with_symmetry_seen_from_above_and_not_without(tmp_path, monkeypatch):
    """The same demonstrations, steps and episodes for both; docs/policies.md has the rates that were measured."""
    config = DemoConfig(output_dir=tmp_path)
    demo(config)
    symmetric = read_success(tmp_path / "evaluation")
    policy, evaluation = tmp_path / "sideview", tmp_path / "sideview_evaluation"
    train = train_command(config, REPO_ID, tmp_path / "recorded", policy, "--policy.method=sideview_nonequi")
    evaluate = evaluate_command(config, policy, evaluation)
    for command, main in ((train, lerobot_train.main), (evaluate, lerobot_eval.main)):
        monkeypatch.setattr(sys, "argv", list(command))
        main()
    plain = read_success(evaluation)
    assert symmetric.episodes == plain.episodes == 50
    assert symmetric.rate >= 0.8
    assert symmetric.rate >= plain.rate + 0.2
