"""Record a dataset, push it to the Hugging Face Hub, pull it, add views, and push the result. Both get a card.

    hf auth login
    python examples/push_to_the_hub.py --repo_id=YOUR_NAME/picking

Both repositories are private until you change this on their pages. After an interrupted upload, run the same command
again.
"""

import argparse
import logging
from pathlib import Path

from lerobot.datasets import LeRobotDataset

from lerobot_symview import AddViewsConfig, add_views
from lerobot_symview.datasets.hub import HubDataset
from symview_sim.generate import GenerateConfig, generate
from symview_sim.settings import NewDataset

logger = logging.getLogger(__name__)


def main(repo_id: str, episodes: int, output_dir: Path) -> None:
    """Push, pull, add views and push again."""
    options = {"push_to_hub": True, "private": True, "tags": ["example"]}
    recorded = NewDataset(repo_id, output_dir / "recorded", **options)
    generate(GenerateConfig(recorded, num_episodes=episodes, resume=True))

    pulled = LeRobotDataset(repo_id)
    logger.info("pulled %d episodes of %s", pulled.num_episodes, repo_id)

    source = HubDataset(repo_id, pulled.root, **options)
    add_views(AddViewsConfig(source, new_root=output_dir / "views", size=76, keep=[], resume=True))
    pulled = LeRobotDataset(f"{repo_id}_views")
    logger.info("pulled %s of %s_views", ", ".join(pulled.meta.camera_keys), repo_id)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--repo_id", required=True, help="name of the new dataset, in a namespace that you may write to"
    )
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/examples/hub"))
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
