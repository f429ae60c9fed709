"""What every encoder is: a map from a picture and a state to equivariant features."""

from __future__ import annotations

from torch import Tensor, nn

from lerobot_policy_symview.symmetry.groups import PlanarGroup


class Encoder(nn.Module):
    """Maps pictures and states (B, D) to features (B, G, n): n fields with their group axis, which a head may keep.

    Args:
        group: G elements.
        fields: n.
    """

    def __init__(self, group: PlanarGroup, fields: int):
        super().__init__()
        self.group, self.fields = group, fields

    def split(self, channels: Tensor) -> Tensor:
        """Give channels (B, G n, ...) of one pixel their group axis: (B, G, n)."""
        return channels.reshape(len(channels), self.group.size, self.fields)
