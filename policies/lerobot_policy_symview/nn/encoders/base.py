"""The base class of all encoders."""

from __future__ import annotations

from torch import Tensor, nn

from lerobot_policy_symview.symmetry.groups import PlanarGroup


class Encoder(nn.Module):
    """Maps observations and states (B, D) to n regular fields (B, G, n).

    Subclasses define `forward(observation, state)`. Heads get the features with their group axis.

    Args:
        group: G elements.
        fields: n.
    """

    def __init__(self, group: PlanarGroup, fields: int):
        super().__init__()
        self.group, self.fields = group, fields

    def split(self, channels: Tensor) -> Tensor:
        """Split channels (B, G n, ...) of a single pixel into regular fields (B, G, n)."""
        return channels.reshape(channels.shape[0], self.group.size, self.fields)
