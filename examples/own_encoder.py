"""An encoder of your own: any network, made equivariant by showing it the scene as every element of the group moves it.

    python examples/own_encoder.py

The check goes from raw observation to action, and holds whatever the network inside is. LeRobot's commands know the
encoder once a package of yours has its name as an entry point, see docs/own_encoder.md.
"""

import argparse
import logging
from importlib.metadata import EntryPoint

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from torch import Tensor, nn

from lerobot_policy_symview import SymviewBcConfig
from lerobot_policy_symview.equivariance import equivariance_errors
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.nn.encoders.base import Encoder
from lerobot_policy_symview.symmetry.groups import PlanarGroup
from lerobot_symview.registry import added

logger = logging.getLogger(__name__)


class MovedScenes(Encoder):
    """Features (B, G, n): what one network says of the scene, moved back by each element of the group."""

    def __init__(self, config: SymviewBcConfig, group: PlanarGroup, state: np.ndarray):
        super().__init__(group, config.width)
        self.register_buffer("moves", torch.tensor(state, dtype=torch.float32), persistent=False)  # (G, D, D)
        self.see = nn.Sequential(nn.Conv2d(config.channels, 32, 8, 4), nn.ReLU(), nn.AdaptiveAvgPool2d(4), nn.Flatten())
        self.tell = nn.Sequential(nn.Linear(32 * 4 * 4 + state.shape[-1], config.width), nn.ReLU())

    def forward(self, picture: Tensor, state: Tensor) -> Tensor:
        """Map pictures (B, C, H, W) and states (B, D) to features."""
        features = []
        for element in range(self.group.size):
            turned = torch.rot90(picture, -element, (-2, -1))
            moved = turned.flip(-1) if self.group.flips(element) else turned
            numbers = state @ self.moves[element]  # orthogonal: this is its inverse times the state
            features.append(self.tell(torch.cat([self.see(moved), numbers], dim=1)))
        return torch.stack(features, dim=1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=16, help="fields of the network; the paper's are 64")
    args = parser.parse_args()
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    added("symview.encoders")["moved"] = EntryPoint("moved", f"{__name__}:MovedScenes", "symview.encoders")
    for encoder in ("moved", "plain"):
        config = SymviewBcConfig(device="cpu", encoder=encoder, width=args.width, crop_size=64)
        config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (5,))}
        errors = equivariance_errors(SymviewBcPolicy(config))
        logger.info("encoder %s: errors up to %.0e", encoder, max(errors.values()))
