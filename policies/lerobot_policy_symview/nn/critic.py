"""The critic: two Q-functions, invariant under planar transforms of scene and action together."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.encoders import make_encoder
from lerobot_policy_symview.inputs.state import StateInput
from lerobot_policy_symview.nn.layers import FieldLinear
from lerobot_policy_symview.symmetry.groups import PlanarGroup, make_group

Q_FUNCTIONS = 2  # clipped double Q-learning: the targets use the smaller one (Fujimoto et al., 2018)


class DoubleQ(nn.Module):
    """Two Q-functions of one hidden layer on shared features: linear to n regular fields, ReLU, group pooling, linear.

    Args:
        group: G elements.
        fields: n, regular fields of the features and of each hidden layer.
        actions: (G, A, A), representation of the scaled actions.
    """

    def __init__(self, group: PlanarGroup, fields: int, actions: NDArray[np.float64]):
        super().__init__()
        self.group, self.fields = group, fields
        self.from_features = FieldLinear(group, fields, Q_FUNCTIONS * fields)
        self.from_action = FieldLinear(group, actions, Q_FUNCTIONS * fields)
        for layer in (self.from_features, self.from_action):  # He et al. (2015), with the fan-in of both together
            nn.init.normal_(layer.weight, std=math.sqrt(2 / (group.size * fields + actions.shape[-1])))
        # The critic head is zero-initialised: the target critic, which changes slowly, would otherwise teach the values
        # of a random network for hundreds of updates.
        self.weight = nn.Parameter(torch.zeros(Q_FUNCTIONS, fields))
        self.bias = nn.Parameter(torch.zeros(Q_FUNCTIONS))

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Map features (B, G, n) and scaled actions (B, A) to Q-values (B, 2)."""
        with torch.autocast(features.device.type, enabled=False):
            features = features.to(self.weight.dtype)
            hidden = self.from_features(features.flatten(1)) + self.from_action(action)
            hidden = functional.relu(hidden).view(-1, self.group.size, Q_FUNCTIONS, self.fields).amax(dim=1)
            return (hidden * self.weight).sum(dim=-1) + self.bias


class Critic(nn.Module):
    """An encoder, separate from the actor's, and two Q-functions of its features.

    Args:
        config: the policy's configuration.
        inputs: the state vector that enters the encoder beside the observation.
    """

    def __init__(self, config: SymviewConfig, inputs: StateInput):
        super().__init__()
        group = make_group(config.group)
        self.encoder = make_encoder(config, group, inputs.representation(group))
        actions = config.actions.matrices(group, config.theta_representation)
        self.q_functions = DoubleQ(group, self.encoder.fields, actions)
