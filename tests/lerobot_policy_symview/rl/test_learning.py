"""What the paper is about, by reinforcement learning: symmetry, seen from above, learns sooner."""

import statistics

import pytest

from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.rl.configuration import TrainRlConfig
from lerobot_policy_symview.rl.records import read_table
from lerobot_policy_symview.rl.train_rl import train_rl
from symview_sim.generate import GenerateConfig, generate
from symview_sim.settings import NewDataset, RecordedDataset


def learning_curve(data, folder, method):
    """Success after every 150 steps, from a camera at 45 degrees."""
    policy = SymviewSacfdConfig(
        device="cpu", method=method, width=16, crop_size=64, expert_weight=10, weight_averaging=0.99
    )
    config = TrainRlConfig(
        dataset=RecordedDataset("test/picking", data),
        policy=policy,
        output_dir=folder,
        steps=600,
        batch_size=32,
        eval_every=150,
        eval_episodes=40,
    )
    train_rl(config)
    return [row["success"] for row in read_table(folder / "evaluation.csv")]


@pytest.mark.slow
def test_twenty_demonstrations_suffice_and_symmetry_learns_sooner(tmp_path):
    """Block picking; docs/reinforcement.md has the rates that were measured."""
    data = generate(GenerateConfig(NewDataset("test/picking", tmp_path / "data"), num_episodes=20))
    symmetric = learning_curve(data, tmp_path / "symmetric", "reproj_equi")
    plain = learning_curve(data, tmp_path / "plain", "sideview_nonequi")
    assert len(symmetric) == len(plain) == 4
    assert max(symmetric) >= 0.7  # success swings by ten points between checkpoints, the rate being constant
    assert statistics.fmean(symmetric) > statistics.fmean(plain)
