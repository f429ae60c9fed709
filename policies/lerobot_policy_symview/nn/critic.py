"""What an action is worth: two estimates that stay the same when the scene and the action move together."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.inputs.state import StateInput
from lerobot_policy_symview.nn.encoders.registry import make_encoder
from lerobot_policy_symview.nn.layers import FieldLinear
from lerobot_policy_symview.symmetry.groups import PlanarGroup, make_group

ESTIMATES = 2  # the smaller one is believed (Fujimoto et al., 2018)


class DoubleQ(nn.Module):
    """Two networks of one hidden layer on shared features: linear to n fields, ReLU, maximum over the group, linear.

    Args:
        group: G elements.
        fields: n, of the features and of each hidden layer.
        actions: (G, A, A), how scaled actions move.
    """

    def __init__(self, group: PlanarGroup, fields: int, actions: NDArray[np.float64]):
        super().__init__()
        self.group, self.fields = group, fields
        self.from_features = FieldLinear(group, fields, ESTIMATES * fields)
        self.from_action = FieldLinear(group, actions, ESTIMATES * fields)
        for layer in (self.from_features, self.from_action):  # He et al. (2015), as for one layer of both
            nn.init.normal_(layer.weight, std=math.sqrt(2 / (group.size * fields + actions.shape[-1])))
        # Nothing is worth anything at first: the target, which follows slowly, would teach random values for long.
        self.weight = nn.Parameter(torch.zeros(ESTIMATES, fields))
        self.bias = nn.Parameter(torch.zeros(ESTIMATES))

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Map features (B, G, n) and scaled actions (B, A) to values (B, 2)."""
        with torch.autocast(features.device.type, enabled=False):
            features = features.to(self.weight.dtype)
            hidden = self.from_features(features.flatten(1)) + self.from_action(action)
            hidden = functional.relu(hidden).view(-1, self.group.size, ESTIMATES, self.fields).amax(dim=1)
            return (hidden * self.weight).sum(dim=-1) + self.bias


class Critic(nn.Module):
    """An encoder of its own, and the two estimates on its features.

    Args:
        config: what to build, as for the actor.
        inputs: the numbers beside the picture.
    """

    def __init__(self, config: SymviewConfig, inputs: StateInput):
        super().__init__()
        group = make_group(config.group)
        self.encoder = make_encoder(config, group, inputs.representation(group))
        actions = config.actions.matrices(group, config.theta_representation)
        self.values = DoubleQ(group, self.encoder.fields, actions)
