"""The image encoder built with escnn: the reference for tests and the benchmark, and a source of weights.

It imports escnn by `escnn_import`; no other module of the package does.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lerobot_policy_symview.nn.encoders.convolutional import ImageEncoder
from lerobot_policy_symview.nn.escnn_import import enn, gspaces
from lerobot_policy_symview.nn.layers import FieldConv2d


class EscnnEncoder(nn.Module):
    """An escnn encoder with the layers and fields of an `ImageEncoder` on D4 whose inputs are all scalars.

    Args:
        like: the encoder that gives the layout.
        initialize: draw escnn's random initialisation, which takes seconds.
    """

    def __init__(self, like: ImageEncoder, initialize: bool = True):
        super().__init__()
        space = gspaces.flipRot2dOnR2(4)
        convolutions = _convolutions(like)
        scalars = convolutions[0].weight.shape[1]
        self.in_type = enn.FieldType(space, scalars * [space.trivial_repr])
        layers: list[enn.EquivariantModule] = []
        current = self.in_type
        for convolution, pool in zip(convolutions, like.pooled, strict=True):
            out_type = enn.FieldType(space, convolution.fields * [space.regular_repr])
            layers.append(enn.R2Conv(current, out_type, 3, padding=convolution.padding, initialize=initialize))
            layers.append(enn.ReLU(out_type))
            if pool:
                layers.append(enn.PointwiseMaxPool(out_type, 2))
            current = out_type
        self.layers = enn.SequentialModule(*layers)

    def forward(self, observation: Tensor, state: Tensor) -> Tensor:
        """Map images (B, C, crop, crop) and scalar states (B, D) to features (B, 8, n), as `ImageEncoder` does."""
        planes = state[:, :, None, None].expand(-1, -1, *observation.shape[-2:])
        features = self.layers(enn.GeometricTensor(torch.cat([observation, planes], dim=1), self.in_type)).tensor
        return features.flatten(1).unflatten(1, (-1, 8)).transpose(1, 2)


@torch.no_grad()
def load_from_escnn(encoder: ImageEncoder, reference: EscnnEncoder) -> None:
    """Set an encoder's weights so that it computes the same function as an escnn encoder of the same layout.

    escnn's filters are linear combinations of the same basis (`steerable_basis`), so the weights follow from the
    filters of the identity's output block. escnn keeps the eight channels of a field together; `FieldConv2d` keeps the
    fields' channels of a group element together.
    """
    sources = [layer for layer in reference.layers if isinstance(layer, enn.R2Conv)]
    for layer, source in zip(_convolutions(encoder), sources, strict=True):
        filters, bias = source.expand_parameters()
        identity = filters.unflatten(0, (layer.fields, layer.group.size))[:, 0].flatten(2)
        if layer.has_field_inputs:
            identity = identity.unflatten(1, (-1, layer.group.size)).transpose(1, 2).flatten(1, 2)
        layer.weight.copy_(identity @ torch.linalg.pinv(layer.basis[0]))
        layer.bias.copy_(bias.unflatten(0, (layer.fields, layer.group.size))[:, 0])


def _convolutions(encoder: ImageEncoder) -> list[FieldConv2d]:
    return [layer for layer in encoder.layers if isinstance(layer, FieldConv2d)]
