"""Train LeRobot's own ACT policy on a view as another camera, and evaluate it with LeRobot's own loop.

    python examples/stock_policy_on_views.py --steps=10000

The policy has none of our code. It takes images of three channels, so the view has no height map. In the evaluation,
the environment renders the same view. The default number of steps is far too small for ACT to succeed.
"""

import argparse
import json
import logging
from pathlib import Path

from lerobot.configs.default import DatasetConfig, EvalConfig
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.scripts.lerobot_eval import eval_main
from lerobot.scripts.lerobot_train import train

from lerobot_policy_symview import SymviewEnvConfig
from lerobot_symview import AddViewsConfig, ViewSpec, add_views
from lerobot_symview.datasets.hub import HubDataset
from symview_sim.generate import GenerateConfig, generate
from symview_sim.settings import NewDataset

logger = logging.getLogger(__name__)
VIEW = ViewSpec("reproj", {"size": 96, "height": False, "source_scale": 2})


def main(demonstrations: int, steps: int, episodes: int, output_dir: Path) -> None:
    """Record demonstrations, add the view, train and evaluate."""
    recorded = NewDataset("me/picking", output_dir / "picking")
    source = HubDataset("me/picking", generate(GenerateConfig(recorded, num_episodes=demonstrations, resume=True)))
    views = add_views(AddViewsConfig(source, new_root=output_dir / "views", views=[VIEW], keep=[], resume=True))

    act = ACTConfig(device="cpu", dim_model=128, n_heads=4, dim_feedforward=256, chunk_size=8, n_action_steps=4)
    act.push_to_hub, act.pretrained_backbone_weights = False, None
    data = DatasetConfig("me/picking_views", root=str(views))
    output = {"output_dir": output_dir / "act", "env_eval_freq": 0, "log_freq": 50}
    train(TrainPipelineConfig(data, policy=act, steps=steps, batch_size=8, num_workers=0, **output))

    act.pretrained_path = output_dir / "act" / "checkpoints" / "last" / "pretrained_model"
    env, size = SymviewEnvConfig(views=[VIEW]), EvalConfig(n_episodes=episodes, batch_size=1)
    eval_main(EvalPipelineConfig(env, size, policy=act, output_dir=output_dir / "evaluation"))
    overall = json.loads((output_dir / "evaluation" / "eval_info.json").read_text())["overall"]
    logger.info("ACT succeeds in %.0f %% of %d episodes", overall["pc_success"], overall["n_episodes"])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demonstrations", type=int, default=20)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--episodes", type=int, default=5, help="episodes of the evaluation")
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/examples/act"))
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
