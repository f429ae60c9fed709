"""What the paper is about, at a size a CPU trains in minutes: symmetry seen from above learns from few episodes."""

import sys

import pytest
from lerobot.scripts import lerobot_eval, lerobot_train

from lerobot_symview.add_views import AddViewsConfig, add_views
from lerobot_symview.cli import DatasetTarget
from symview_eval.report import read_success
from symview_sim.generate import GenerateConfig, RecordedDataset, generate

DEMONSTRATIONS = 20
STEPS = 800
EPISODES = 50


@pytest.mark.slow
def test_reprojection_with_symmetry_beats_the_side_view_without(tmp_path, monkeypatch):
    """Block picking at 45 degrees; docs/policies.md has the rates that were measured."""
    recorded, views = tmp_path / "recorded", tmp_path / "views"
    generate(GenerateConfig(RecordedDataset("test/picking", recorded), num_episodes=DEMONSTRATIONS))
    add_views(AddViewsConfig(DatasetTarget("test/picking", recorded), "test/views", views, size=76))
    rates = {}
    for method in ("reproj_equi", "sideview_nonequi"):
        policy, evaluation = tmp_path / method, tmp_path / f"{method}_evaluation"
        train = (
            "lerobot-train",
            "--dataset.repo_id=test/views",
            f"--dataset.root={views}",
            "--policy.type=symview_bc",
            f"--policy.method={method}",
            "--policy.width=16",
            "--policy.crop_size=64",
            "--policy.learning_rate_decay=cosine",
            "--policy.weight_averaging=0.99",
            "--policy.device=cpu",
            "--policy.push_to_hub=false",
            f"--steps={STEPS}",
            f"--save_freq={STEPS}",
            "--batch_size=32",
            "--num_workers=0",
            "--env_eval_freq=0",
            f"--output_dir={policy}",
        )
        evaluate = (
            "lerobot-eval",
            f"--policy.path={policy}/checkpoints/last/pretrained_model",
            "--policy.device=cpu",
            "--env.type=symview",
            "--env.task=block_picking",
            f"--eval.n_episodes={EPISODES}",
            "--eval.batch_size=10",
            "--eval.use_async_envs=false",
            f"--output_dir={evaluation}",
        )
        for command, main in ((train, lerobot_train.main), (evaluate, lerobot_eval.main)):
            monkeypatch.setattr(sys, "argv", list(command))
            main()
        rates[method] = read_success(evaluation).rate
    assert rates["reproj_equi"] >= 0.8, rates
    assert rates["reproj_equi"] >= rates["sideview_nonequi"] + 0.2, rates
