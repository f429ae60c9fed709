"""Finite groups of planar rotations and reflections, their multiplication tables and their representations."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.registry import lookup

GROUP_NAMES = ("D4", "C4", "D8", "C8", "C1")
DECIMALS = 12  # rounds cos(90 degrees), 6e-17 in float64, to an exact 0


@dataclass(frozen=True)
class PlanarGroup:
    """The cyclic group C_N (rotations by multiples of 360 degrees / N) or the dihedral group D_N (with reflections).

    Element `reflected * N + k` reflects the scene in the plane y = 0 if `reflected` is 1, then rotates it by
    k 360 / N degrees about z.

    Args:
        rotations: N, the number of rotations.
        reflections: whether the group contains reflections.
    """

    rotations: int
    reflections: bool

    @property
    def size(self) -> int:
        """Number of elements."""
        return self.rotations * (1 + self.reflections)

    @property
    def is_exact(self) -> bool:
        """Whether every element maps the pixels of a square image onto pixels."""
        return self.rotations in (1, 2, 4)

    def angle(self, element: int) -> float:
        """Angle of the element's rotation, radians."""
        return 2 * np.pi * (element % self.rotations) / self.rotations

    def reflects(self, element: int) -> bool:
        """Whether the element contains the reflection y -> -y."""
        return element >= self.rotations

    @cached_property
    def product(self) -> NDArray[np.int64]:
        """(G, G): entry [g, h] is the element g h, which applies h first, then g."""
        rotation, reflection = np.arange(self.size) % self.rotations, np.arange(self.size) // self.rotations
        sign = 1 - 2 * reflection
        angle = (rotation[:, None] + sign[:, None] * rotation[None]) % self.rotations
        return (reflection[:, None] ^ reflection[None]) * self.rotations + angle

    @cached_property
    def inverse(self) -> NDArray[np.int64]:
        """(G,): the inverse of each element."""
        return np.argmin(self.product, axis=1)  # the identity is element 0

    @cached_property
    def quotient(self) -> NDArray[np.int64]:
        """(G, G): entry [g, h] is the element g^-1 h, which permutes the channels of a regular field."""
        return self.product[self.inverse]

    @cached_property
    def determinants(self) -> NDArray[np.float64]:
        """(G,): -1 for a reflection, 1 for a rotation."""
        return np.where(np.arange(self.size) >= self.rotations, -1.0, 1.0)

    def rotation(self, frequency: int = 1) -> NDArray[np.float64]:
        """Return the two-dimensional representation (G, 2, 2) of a frequency; frequency 1 transforms vectors (x, y).

        It acts on (cos, sin) of `frequency` times the angle of a direction: the reflection negates the sine, a rotation
        by an angle a rotates the pair by `frequency` a.
        """
        angle = frequency * 2 * np.pi * (np.arange(self.size) % self.rotations) / self.rotations
        cos, sin = np.cos(angle), np.sin(angle)
        matrices = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], axis=-2)
        matrices[..., 1] *= self.determinants[:, None]
        return matrices.round(DECIMALS) + 0.0


@lru_cache
def _named() -> dict[str, Any]:
    return {name: PlanarGroup(int(name[1:]), name[0] == "D") for name in GROUP_NAMES}


def make_group(name: str) -> PlanarGroup:
    """Return the group called `name`, one of `GROUP_NAMES`; D4 is the symmetry of a square."""
    group: PlanarGroup = lookup("--policy.group", name, _named())
    return group


def block_diagonal(blocks: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the direct sum (G, d, d) of representations (G, d_i, d_i): one block each on the diagonal."""
    size = sum(block.shape[-1] for block in blocks)
    joined = np.zeros((len(blocks[0]), size, size))
    start = 0
    for block in blocks:
        stop = start + block.shape[-1]
        joined[:, start:stop, start:stop] = block
        start = stop
    return joined
