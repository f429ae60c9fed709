"""Record demonstrations of a simulated SO-101 in joints, by the loop of `lerobot-record`.

    python examples/so101_record.py --episodes=80

A scripted expert takes the place of the leader arm. The robot is `--robot.type=so101_sim` of LeRobot's commands.
"""

import argparse
import logging
from pathlib import Path

from lerobot.datasets import LeRobotDataset
from lerobot.processor import make_default_processors
from lerobot.scripts import lerobot_record
from lerobot.utils.feature_utils import hw_to_dataset_features

from lerobot_policy_symview.config_so101_sim import So101SimConfig
from lerobot_policy_symview.so101_leader import So101Leader
from lerobot_policy_symview.so101_sim import So101Sim

logger = logging.getLogger(__name__)
FPS = 10


def main(repo_id: str, root: Path | None, episodes: int, seed: int) -> None:
    """Record a dataset: the joints and their targets in degrees, and the camera's colour and depth."""
    lerobot_record.precise_sleep = lambda seconds: None  # the robot's clock advances by its actions
    robot = So101Sim(So101SimConfig(id="recorded"))
    robot.connect()
    events = {"exit_early": False}
    leader = So101Leader(robot, events)
    features = hw_to_dataset_features(robot.observation_features, "observation", use_video=False)
    features |= hw_to_dataset_features(robot.action_features, "action")
    dataset = LeRobotDataset.create(repo_id, FPS, features, root, robot.name, use_videos=False)
    from_leader, to_robot, from_robot = make_default_processors()
    for episode in range(episodes):
        robot.reset(seed + episode)
        lerobot_record.record_loop(
            robot, events, FPS, from_leader, to_robot, from_robot, dataset, leader, 60, "Lift the cube."
        )
        dataset.save_episode()
        logger.info("episode %d: %s", episode, "the cube is lifted" if robot.is_solved else "failed")
    dataset.finalize()
    robot.disconnect()
    logger.info("%d frames in %s", dataset.num_frames, dataset.root)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repo_id", default="me/so101")
    parser.add_argument("--root", type=Path, help="folder of the dataset; by default in LeRobot's cache")
    parser.add_argument("--episodes", type=int, default=80)
    parser.add_argument("--seed", type=int, default=0, help="scene of the first episode")
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
