"""Say how the actions and the state of a robot of your own move with the scene, and check that a policy follows.

    python examples/own_robot.py

The robot below turns its tool by a rotation vector. Declared as a vector like (dx, dy), it would turn with the scene as
it should, and go the wrong way in a mirror image: the errors tell in which motions the declarations differ.
"""

import argparse
import logging
from typing import Any

import torch

from lerobot_policy_symview import SymviewBcConfig
from lerobot_policy_symview.equivariance import assert_equivariant, checked_group, describe, equivariance_errors
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy

logger = logging.getLogger(__name__)
STATE = {"opening": "aperture", "x": "x", "y": "y", "z": "z", "force": "scalar"}  # x, y from the workspace's centre
ACTION = {"opening": "aperture", "dz": "z", "dx": "x", "dy": "y", "roll": "rx", "pitch": "ry", "dyaw": "yaw"}
WRONG = ACTION | {"roll": "x:tool", "pitch": "y:tool"}


def make_policy(actions: dict[str, str], width: int) -> SymviewBcPolicy:
    """Return an untrained policy for a dataset of this robot."""
    declared: dict[str, Any] = {"state_symmetry": list(STATE.values()), "action_symmetry": list(actions.values())}
    # `vector` gives the network the state's numbers; the default draws a gripper whose yaw this state does not tell.
    declared |= {"gripper_input": "vector"}
    config = SymviewBcConfig(device="cpu", camera="front", width=width, crop_size=64, **declared)
    features = {
        "observation.images.front": {"dtype": "image", "shape": (480, 640, 3)},
        "observation.images.front_depth": {"dtype": "image", "shape": (480, 640, 1)},
        "observation.state": {"dtype": "float32", "shape": (len(STATE),), "names": list(STATE)},
        "action": {"dtype": "float32", "shape": (len(ACTION),), "names": list(ACTION)},
    }
    config.set_dataset_feature_metadata(features)  # in training, LeRobot does so with those of the dataset
    torch.manual_seed(0)
    return SymviewBcPolicy(config)


def main(width: int) -> None:
    """Check a policy of the right declaration, and one of the wrong one."""
    assert_equivariant(make_policy(ACTION, width))
    logger.info("declared rightly: equivariant")

    wrong = make_policy(WRONG, width)
    wrong.config.action_symmetry = list(ACTION.values())  # made for one declaration, held to the other
    for element, error in equivariance_errors(wrong).items():
        logger.info("declared wrongly, %s: %.0e", describe(checked_group(wrong.config), element), error)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=16, help="fields of the network; the paper's are 64")
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
