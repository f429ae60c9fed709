"""Declare how your robot's state and action transform with the scene, and check that a policy is equivariant.

    python examples/own_robot.py

The robot below rotates its tool by a rotation vector. Declared as an ordinary vector like (dx, dy), it transforms
correctly under rotations and wrongly under reflections: the errors name the planar transforms that are violated.
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
    declared |= {"gripper_input": "vector"}  # the default draws the gripper, whose yaw this state lacks
    config = SymviewBcConfig(device="cpu", camera="front", width=width, crop_size=64, **declared)
    features = {
        "observation.images.front": {"dtype": "image", "shape": (480, 640, 3)},
        "observation.images.front_depth": {"dtype": "image", "shape": (480, 640, 1)},
        "observation.state": {"dtype": "float32", "shape": (len(STATE),), "names": list(STATE)},
        "action": {"dtype": "float32", "shape": (len(ACTION),), "names": list(ACTION)},
    }
    config.set_dataset_feature_metadata(features)  # lerobot-train passes the dataset's features
    torch.manual_seed(0)
    return SymviewBcPolicy(config)


def main(width: int) -> None:
    """Check a policy with the correct declaration, and a policy with a wrong one."""
    assert_equivariant(make_policy(ACTION, width))
    logger.info("correct declaration: equivariant")

    wrong = make_policy(WRONG, width)
    wrong.config.action_symmetry = list(ACTION.values())  # built for one declaration, tested on the other
    for element, error in equivariance_errors(wrong).items():
        logger.info("wrong declaration, %s: %.0e", describe(checked_group(wrong.config), element), error)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=16, help="regular fields of the network; 64 in the paper")
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
