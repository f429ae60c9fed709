"""Features of a camera on the gripper, beside those of the scene."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from lerobot_policy_symview.nn.encoders.base import Encoder

NORM_GROUPS = 8
CELLS = 4  # rows and columns of the last feature map


class WristEncoder(Encoder):
    """Appends regular fields of a gripper camera's image to the features of the scene.

    A camera on the gripper turns with the scene, so that rotations leave its image I; a reflection flips it. With an
    ordinary network f, the feature of a group element is f(I) for a rotation and f(flip I) for a reflection: a regular
    field.

    Args:
        scene: the encoder of the scene, n fields.
        fields: fields to append, a multiple of 16.
    """

    def __init__(self, scene: Encoder, fields: int):
        super().__init__(scene.group, scene.fields + fields)
        self.scene = scene
        widths = (3, fields // 2, fields, 2 * fields, 2 * fields)
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise(widths):
            convolution = nn.Conv2d(inputs, outputs, 3, stride=2, padding=1)
            layers += [convolution, nn.GroupNorm(NORM_GROUPS, outputs), nn.ReLU()]
        layers += [nn.AdaptiveAvgPool2d(CELLS), nn.Flatten(), nn.Linear(widths[-1] * CELLS**2, fields), nn.ReLU()]
        self.image = nn.Sequential(*layers)

    def forward(self, observation: tuple[Tensor, Tensor], state: Tensor) -> Tensor:
        """Map the scene and gripper images (B, 3, size, size), and states (B, D), to features (B, G, n + fields)."""
        scene, images = observation
        features = self.scene(scene, state)
        turned = self.image(images)[:, None].expand(-1, self.group.rotations, -1)
        if self.group.reflections:
            flipped = self.image(images.flip(-1))[:, None].expand(-1, self.group.rotations, -1)
            turned = torch.cat([turned, flipped], dim=1)
        return torch.cat([features, turned.to(features.dtype)], dim=-1)
