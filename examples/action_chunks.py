"""Flow matching over action chunks, from demonstrations in the style of people, with LeRobot's own loops.

    python examples/action_chunks.py --demonstrations=25 --steps=3000

People do a task in several ways; `symview_flow` chooses one of them. The run takes some minutes on two cores.
"""

import argparse
import json
import logging
from pathlib import Path

from lerobot.configs.default import DatasetConfig, EvalConfig
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.scripts.lerobot_eval import eval_main
from lerobot.scripts.lerobot_train import train

from lerobot_policy_symview import SymviewEnvConfig, SymviewFlowConfig
from lerobot_symview import AddViewsConfig, add_views
from lerobot_symview.datasets.hub import HubDataset
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset

logger = logging.getLogger(__name__)


def main(demonstrations: int, steps: int, episodes: int, output_dir: Path) -> None:
    """Record demonstrations at 10 Hz, add the view, train and evaluate."""
    recorded = NewDataset("me/people", output_dir / "people")
    people = RecordedEnv(control="fine", style="human", oracle=False)
    source = HubDataset("me/people", generate(GenerateConfig(recorded, people, demonstrations, resume=True)))
    views = add_views(AddViewsConfig(source, new_root=output_dir / "views", size=76, keep=[], resume=True))

    flow = SymviewFlowConfig(device="cpu", width=16, crop_size=64, aperture_noise=0.03, push_to_hub=False)
    data = DatasetConfig("me/people_views", root=str(views))
    output = {"output_dir": output_dir / "flow", "env_eval_freq": 0, "log_freq": 50}
    train(TrainPipelineConfig(data, policy=flow, steps=steps, batch_size=16, num_workers=0, **output))

    flow.pretrained_path = output_dir / "flow" / "checkpoints" / "last" / "pretrained_model"
    env, size = SymviewEnvConfig(control="fine"), EvalConfig(n_episodes=episodes, batch_size=1)
    eval_main(EvalPipelineConfig(env, size, policy=flow, output_dir=output_dir / "evaluation"))
    overall = json.loads((output_dir / "evaluation" / "eval_info.json").read_text())["overall"]
    logger.info("%.0f %% of %d episodes succeed", overall["pc_success"], overall["n_episodes"])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demonstrations", type=int, default=25)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--episodes", type=int, default=20, help="episodes of the evaluation")
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/examples/chunks"))
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
