"""The demo at its full size: what a newcomer is promised, and what the paper is about."""

import sys

import pytest
from lerobot.scripts import lerobot_eval, lerobot_train

from symview_eval.demo import REPO_ID, TASK, DemoConfig, demo
from symview_eval.report import read_success


@pytest.mark.slow
def test_twenty_demonstrations_suffice_with_symmetry_seen_from_above_and_not_without(tmp_path, monkeypatch):
    """The same demonstrations, steps and episodes for both; docs/policies.md has the rates that were measured."""
    config = DemoConfig(output_dir=tmp_path)
    demo(config)
    symmetric = read_success(tmp_path / "evaluation")
    policy, evaluation = tmp_path / "sideview", tmp_path / "sideview_evaluation"
    train = (
        "lerobot-train",
        f"--dataset.repo_id={REPO_ID}",
        f"--dataset.root={tmp_path / 'recorded'}",
        "--policy.type=symview_bc",
        "--policy.method=sideview_nonequi",
        "--policy.width=16",
        "--policy.crop_size=64",
        "--policy.learning_rate_decay=cosine",
        "--policy.weight_averaging=0.99",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        f"--steps={config.steps}",
        f"--save_freq={config.steps}",
        f"--batch_size={config.batch_size}",
        "--num_workers=0",
        "--env_eval_freq=0",
        f"--seed={config.seed}",
        f"--output_dir={policy}",
    )
    evaluate = (
        "lerobot-eval",
        f"--policy.path={policy}/checkpoints/last/pretrained_model",
        "--policy.device=cpu",
        "--env.type=symview",
        f"--env.task={TASK}",
        f"--eval.n_episodes={config.eval_episodes}",
        "--eval.batch_size=10",
        "--eval.use_async_envs=false",
        f"--output_dir={evaluation}",
    )
    for command, main in ((train, lerobot_train.main), (evaluate, lerobot_eval.main)):
        monkeypatch.setattr(sys, "argv", list(command))
        main()
    plain = read_success(evaluation)
    assert symmetric.episodes == plain.episodes == 50
    assert symmetric.rate >= 0.8
    assert symmetric.rate >= plain.rate + 0.2
