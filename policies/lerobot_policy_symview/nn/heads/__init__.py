"""Heads: maps from an encoder's features (B, G, n) to actions, with the loss that trains them.

A head may contract the group axis G at once, as the linear heads do, or first apply a network with shared weights to
every group element's features.
"""

from lerobot_policy_symview.nn.heads.flow import FlowHead
from lerobot_policy_symview.nn.heads.gaussian import GaussianHead
from lerobot_policy_symview.nn.heads.linear import EquivariantLinear
from lerobot_policy_symview.nn.heads.regression import RegressionHead

__all__ = ["EquivariantLinear", "FlowHead", "GaussianHead", "RegressionHead"]
