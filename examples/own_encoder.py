"""An encoder of your own: any network, made equivariant by running it on the scene transformed by every group element.

    python examples/own_encoder.py

The check covers the path from raw observation to action. The decorator registers the encoder in this process; an entry
point of a package makes it known to LeRobot's commands, see docs/own_encoder.md.
"""

import argparse
import logging

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from torch import Tensor, nn

from lerobot_policy_symview import SymviewBcConfig, register_encoder
from lerobot_policy_symview.equivariance import equivariance_errors
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.nn.encoders.base import Encoder
from lerobot_policy_symview.symmetry.groups import PlanarGroup

logger = logging.getLogger(__name__)


@register_encoder("transformed")
class TransformedScenes(Encoder):
    """Features (B, G, n): the same network applied to the scene, transformed by the inverse of each group element."""

    def __init__(self, config: SymviewBcConfig, group: PlanarGroup, state: np.ndarray):
        super().__init__(group, config.width)
        self.register_buffer("state_rep", torch.tensor(state, dtype=torch.float32), persistent=False)  # (G, D, D)
        self.image_net = nn.Sequential(
            nn.Conv2d(config.channels, 32, 8, 4), nn.ReLU(), nn.AdaptiveAvgPool2d(4), nn.Flatten()
        )
        self.joint_net = nn.Sequential(nn.Linear(32 * 4 * 4 + state.shape[-1], config.width), nn.ReLU())

    def forward(self, observation: Tensor, state: Tensor) -> Tensor:
        """Map observations (B, C, H, W) and states (B, D) to features."""
        features = []
        for element in range(self.group.size):
            rotated = torch.rot90(observation, -element, (-2, -1))
            image = rotated.flip(-1) if self.group.reflects(element) else rotated
            vector = state @ self.state_rep[element]  # orthogonal: its inverse times the state
            features.append(self.joint_net(torch.cat([self.image_net(image), vector], dim=1)))
        return torch.stack(features, dim=1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=16, help="regular fields of the network; 64 in the paper")
    args = parser.parse_args()
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    for encoder in ("transformed", "plain"):
        config = SymviewBcConfig(device="cpu", encoder=encoder, width=args.width, crop_size=64)
        config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (5,))}
        errors = equivariance_errors(SymviewBcPolicy(config))
        logger.info("encoder %s: errors up to %.0e", encoder, max(errors.values()))
