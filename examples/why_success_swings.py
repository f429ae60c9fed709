"""At a constant learning rate, success varies from checkpoint to checkpoint, because of the observed aperture.

    python examples/why_success_swings.py --seed=1

An expert always opens the gripper to the same aperture; a policy observes apertures that no demonstration has. Every
checkpoint is evaluated unchanged, then with observed apertures above 0.85 set to 1. `--noise=0.03` adds training noise.
"""

import argparse
import logging
from pathlib import Path

import numpy as np
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.scripts.lerobot_train import train

from lerobot_policy_symview import SymviewBcConfig
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.rl.rollouts import Actor, evaluate, simulator_config
from lerobot_symview import AddViewsConfig, add_views
from lerobot_symview.datasets.hub import HubDataset
from symview_sim.generate import GenerateConfig, generate
from symview_sim.settings import EnvSettings, NewDataset
from symview_sim.simulators import Simulators

logger = logging.getLogger(__name__)


def as_if_open(observation: dict) -> dict:
    """Return the observation with an aperture above 0.85 set to 1."""
    *pose, a = observation["observation.state"]
    return observation | {"observation.state": np.array([*pose, 1.0 if a > 0.85 else a], dtype=np.float32)}


def main(steps: int, episodes: int, demonstrations: int, noise: float, seed: int, output_dir: Path) -> None:
    """Record, train, and evaluate every checkpoint twice on the same scenes."""
    picking = NewDataset("me/picking", output_dir / "picking")
    source = HubDataset("me/picking", generate(GenerateConfig(picking, num_episodes=demonstrations, resume=True)))
    views = add_views(AddViewsConfig(source, new_root=output_dir / "views", size=76, keep=[], resume=True))
    policy = SymviewBcConfig(device="cpu", width=16, crop_size=64, aperture_noise=noise, push_to_hub=False)
    options = {"save_freq": max(steps // 12, 1), "env_eval_freq": 0, "log_freq": 100, "seed": seed, "num_workers": 0}
    options |= {"dataset": DatasetConfig("me/picking_views", root=str(views)), "steps": steps, "batch_size": 16}
    train(TrainPipelineConfig(policy=policy, output_dir=output_dir / f"policy_{noise:g}_{seed}", **options))
    for checkpoint in sorted((output_dir / f"policy_{noise:g}_{seed}" / "checkpoints").glob("0*")):
        act = Actor(SymviewBcPolicy.from_pretrained(checkpoint / "pretrained_model"))
        actors = act, lambda observations, act=act: act([*map(as_if_open, observations)])
        with Simulators(simulator_config(act.policy.config, EnvSettings("block_picking")), count=2) as simulators:
            rates = [100 * evaluate(a, simulators, range(1000, 1000 + episodes), 0.99).success_rate for a in actors]
        logger.info("step %s: %.0f %%, %.0f %% as if open", checkpoint.name, *rates)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/examples/swing"))
    for name, default in (("steps", 1200), ("episodes", 60), ("demonstrations", 20), ("noise", 0.0), ("seed", 0)):
        parser.add_argument(f"--{name}", type=type(default), default=default)
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
