"""Behaviour cloning with LeRobot's own training loop, in this process, and the success rate on unseen scenes.

    python examples/train_and_evaluate.py --steps=1000

Without --dataset, demonstrations are recorded and views added first. The run takes some minutes on two cores.
"""

import argparse
import logging
from pathlib import Path

from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.scripts.lerobot_train import train

from lerobot_policy_symview import SymviewBcConfig
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.rl.rollouts import EVALUATION_SEED, Actor, evaluate, simulator_config
from lerobot_symview import AddViewsConfig, add_views
from lerobot_symview.datasets.hub import HubDataset
from symview_sim.generate import GenerateConfig, generate
from symview_sim.settings import EnvSettings, NewDataset
from symview_sim.simulators import Simulators

logger = logging.getLogger(__name__)


def demonstrate(folder: Path) -> Path:
    """Record demonstrations, add the policy's view, and return the folder of the result."""
    recorded = generate(GenerateConfig(NewDataset("me/picking", folder / "picking"), num_episodes=20, resume=True))
    source = HubDataset("me/picking", recorded)
    return add_views(AddViewsConfig(source, new_root=folder / "views", size=76, keep=[], resume=True))


def main(dataset: Path | None, steps: int, episodes: int, output_dir: Path) -> None:
    """Train and evaluate."""
    data = DatasetConfig("me/picking_views", root=str(dataset or demonstrate(output_dir)))
    policy = SymviewBcConfig(device="cpu", width=16, crop_size=64, learning_rate_decay="cosine", push_to_hub=False)
    output = {"output_dir": output_dir / "policy", "env_eval_freq": 0, "log_freq": 50}
    train(TrainPipelineConfig(data, policy=policy, steps=steps, batch_size=16, num_workers=0, **output))

    checkpoint = output_dir / "policy" / "checkpoints" / "last" / "pretrained_model"
    actor = Actor(SymviewBcPolicy.from_pretrained(checkpoint))
    seeds = range(EVALUATION_SEED, EVALUATION_SEED + episodes)
    with Simulators(simulator_config(actor.policy.config, EnvSettings("block_picking")), count=2) as simulators:
        evaluation = evaluate(actor, simulators, seeds, discount=0.99)
    logger.info("%d of %d episodes succeed with the policy in %s", sum(evaluation.success), episodes, checkpoint)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, help="folder of a dataset of block_picking with the view `reproj`")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--episodes", type=int, default=20, help="episodes of the evaluation")
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/examples/cloning"))
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
