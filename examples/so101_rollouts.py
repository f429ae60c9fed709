"""Let a checkpoint drive the simulated SO-101 as `lerobot-rollout` does, and count the cubes that it lifts.

    python examples/so101_rollouts.py --policy=outputs/so101/checkpoints/last/pretrained_model --scenes=50

Any LeRobot policy will do that was trained on the joints, or on a dataset that symview-convert-actions made of them.
"""

import argparse
import logging
from threading import Event

from lerobot.configs.policies import PreTrainedConfig
from lerobot.rollout import RolloutConfig, build_rollout_context
from lerobot.rollout.strategies.core import send_next_action
from lerobot.utils.action_interpolator import ActionInterpolator
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_policy_symview.config_so101_sim import So101SimConfig

logger = logging.getLogger(__name__)
FPS = 10


def main(policy: str, scenes: int, seed: int, seconds: float) -> int:
    """Return in how many scenes the cube is lifted."""
    register_third_party_plugins()
    config = PreTrainedConfig.from_pretrained(policy)
    config.pretrained_path = policy
    robot = So101SimConfig(id="rollout")
    context = build_rollout_context(RolloutConfig(robot=robot, policy=config, fps=FPS, task="Lift the cube."), Event())
    follower, interpolator = context.hardware.robot_wrapper, ActionInterpolator()
    solved = 0
    for scene in range(seed, seed + scenes):
        follower.inner.reset(scene)
        context.policy.inference.reset()
        interpolator.reset()
        for _ in range(round(FPS * seconds)):
            observed = follower.get_observation()
            processed = context.processors.robot_observation_processor(observed)
            send_next_action(processed, observed, context, interpolator)
            if follower.inner.is_solved:
                break
        solved += follower.inner.is_solved
        logger.info("scene %d: %s, %d so far", scene, "lifted" if follower.inner.is_solved else "failed", solved)
    follower.inner.disconnect()
    logger.info("%d of %d cubes are lifted", solved, scenes)
    return solved


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", required=True, help="folder of a checkpoint, or its name on the Hub")
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=100_000, help="first scene; demonstrations have those from 0")
    parser.add_argument("--seconds", type=float, default=6.0, help="longest time in a scene")
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
