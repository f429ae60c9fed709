"""Planar transforms of the scene: a reflection or not, then a rotation about the workspace centre."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_policy_symview.symmetry.groups import PlanarGroup


@dataclass(frozen=True)
class PlanarTransform:
    """One transform per sample: y -> -y if `reflected`, then a rotation by `angle` about z.

    Args:
        angle: (B,) radians.
        reflected: (B,) bool.
    """

    angle: Tensor
    reflected: Tensor

    @classmethod
    def of_element(cls, group: PlanarGroup, element: int, like: Tensor) -> PlanarTransform:
        """Return the transform by a group element for every sample of `like` (B, ...)."""
        angle = like.new_full((len(like),), group.angle(element))
        return cls(angle, torch.full_like(angle, group.reflects(element), dtype=torch.bool))

    def repeated(self, times: int) -> PlanarTransform:
        """Return the transforms of a batch that holds these samples `times` times, one copy after the other."""
        return PlanarTransform(self.angle.repeat(times), self.reflected.repeat(times))

    @property
    def determinant(self) -> Tensor:
        """(B,): -1 for reflected samples, else 1."""
        return 1 - 2 * self.reflected.to(self.angle.dtype)

    def apply(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Transform vectors with components x and y, (B, ...) each."""
        shape = (-1, *[1] * (x.ndim - 1))
        cos, sin = torch.cos(self.angle).view(shape), torch.sin(self.angle).view(shape)
        y = y * self.determinant.view(shape)
        return cos * x - sin * y, sin * x + cos * y
