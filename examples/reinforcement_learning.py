"""Soft actor-critic from demonstrations, with simulators in parallel processes.

    python examples/reinforcement_learning.py --steps=1000

The default is a short run of a small network: some minutes on two cores. `--steps=1000` learns more. Ctrl-C saves a
checkpoint and ends the run; the same command continues it.
"""

import argparse
import logging
from pathlib import Path

from lerobot_policy_symview import SymviewSacfdConfig
from lerobot_policy_symview.rl.train_config import TrainRlConfig
from lerobot_policy_symview.rl.train_rl import train_rl
from symview_sim.generate import GenerateConfig, generate
from symview_sim.settings import EnvSettings, NewDataset

logger = logging.getLogger(__name__)


def main(demonstrations: int, steps: int, simulators: int, episodes: int, output_dir: Path) -> None:
    """Record demonstrations, train, and print the evaluation results."""
    dataset = NewDataset("me/picking", output_dir / "picking")
    generate(GenerateConfig(dataset, num_episodes=demonstrations, resume=True))
    config = TrainRlConfig(
        dataset=dataset,
        env=EnvSettings(task="block_picking"),
        policy=SymviewSacfdConfig(device="cpu", width=16, crop_size=64, bc_weight=10, weight_averaging=0.99),
        output_dir=output_dir / "sacfd",
        steps=steps,
        batch_size=32,
        num_simulators=simulators,
        eval_every=max(1, steps // 4),
        eval_episodes=episodes,
        resume=(output_dir / "sacfd" / "checkpoints").exists(),
    )
    checkpoint = train_rl(config)
    logger.info("%s", (config.output_dir / "evaluation.csv").read_text())
    logger.info("the policy is in %s", checkpoint / "pretrained_model")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demonstrations", type=int, default=20)
    parser.add_argument("--steps", type=int, default=400, help="updates; every simulator takes one action per update")
    parser.add_argument("--simulators", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=20, help="episodes of each of four evaluations")
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/examples/sacfd"))
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
