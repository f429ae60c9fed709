"""Record demonstrations of a task's expert with a camera at a position of your choice, and open them with LeRobot.

    python examples/record_demonstrations.py --task=drawer_opening --azimuth_deg=120

The camera is named `front`, has the depth noise of a real sensor, and changes its azimuth a little in every episode.
"""

import argparse
import logging
from pathlib import Path

from lerobot.datasets import LeRobotDataset

from lerobot_symview import CameraSpec, keys
from lerobot_symview.geometry.placement import CameraSpread
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset

logger = logging.getLogger(__name__)


def main(task: str, azimuth_deg: float, episodes: int, output_dir: Path) -> None:
    """Record a dataset, open it and print its features."""
    camera = CameraSpec(
        name="front",
        height=120,
        width=160,
        elevation_deg=40,
        azimuth_deg=azimuth_deg,
        spread=CameraSpread(azimuth_deg=5),
        depth_noise=0.002,
    )
    config = GenerateConfig(
        dataset=NewDataset("me/demonstrations", output_dir),
        env=RecordedEnv(task=task, camera=camera, oracle=False),
        num_episodes=episodes,
        resume=True,  # after an interruption, the same command continues
    )
    folder = generate(config)

    dataset = LeRobotDataset("me/demonstrations", root=folder, depth_output_unit="m")
    frame = dataset[0]
    logger.info("%d episodes, %d frames: %s", dataset.num_episodes, dataset.num_frames, frame["task"])
    for key, feature in dataset.meta.features.items():
        logger.info("  %-45s %-8s %s", key, feature["dtype"], tuple(feature["shape"]))
    x, y, z = frame[keys.world_from_cam("front")].reshape(4, 4)[:3, 3].tolist()
    depth = frame[keys.depth("front")]
    logger.info("in the first frame, the camera is at (%.2f, %.2f, %.2f) m", x, y, z)
    logger.info("its depth ranges from %.2f to %.2f m", depth[depth > 0].min(), depth.max())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="block_stacking")
    parser.add_argument("--azimuth_deg", type=float, default=60, help="0 faces the robot")
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/examples/demonstrations"))
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
