"""Finite groups of turns and mirrorings of the table, and how they move vectors, angles and each other."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.registry import lookup

GROUP_NAMES = ("D4", "C4", "D8", "C8", "C1")
DECIMALS = 12  # what is left of cos(90 degrees) after rounding: nothing, in float32 as in float64


@dataclass(frozen=True)
class PlanarGroup:
    """C_N, the turns by multiples of 360 degrees / N, or D_N, which mirrors too.

    Element `flip * N + k` mirrors the scene in the plane y = 0 if `flip`, then turns it by k 360 / N degrees about z.

    Args:
        turns: N.
        mirrors: whether mirror images belong to it.
    """

    turns: int
    mirrors: bool

    @property
    def size(self) -> int:
        """Number of elements."""
        return self.turns * (1 + self.mirrors)

    @property
    def is_exact(self) -> bool:
        """Whether every element maps the pixels of a square image onto pixels."""
        return self.turns in (1, 2, 4)

    def angle(self, element: int) -> float:
        """Angle of the element's turn, radians."""
        return 2 * np.pi * (element % self.turns) / self.turns

    def flips(self, element: int) -> bool:
        """Whether the element mirrors."""
        return element >= self.turns

    @cached_property
    def product(self) -> NDArray[np.int64]:
        """(G, G): entry [g, h] is the element that does h, then g."""
        turn, flip = np.arange(self.size) % self.turns, np.arange(self.size) // self.turns
        sign = 1 - 2 * flip
        angle = (turn[:, None] + sign[:, None] * turn[None]) % self.turns
        return (flip[:, None] ^ flip[None]) * self.turns + angle

    @cached_property
    def inverse(self) -> NDArray[np.int64]:
        """(G,): the element that undoes each."""
        return np.argmin(self.product, axis=1)  # the identity is element 0

    @cached_property
    def quotient(self) -> NDArray[np.int64]:
        """(G, G): entry [g, h] is g^-1 h, which is how a regular field's channels are shuffled."""
        return self.product[self.inverse]

    @cached_property
    def determinants(self) -> NDArray[np.float64]:
        """(G,): -1 for an element that mirrors, else 1."""
        return np.where(np.arange(self.size) >= self.turns, -1.0, 1.0)

    def rotation(self, frequency: int = 1) -> NDArray[np.float64]:
        """(G, 2, 2): how (cos, sin) of `frequency` times a direction's angle change; frequency 1 moves vectors (x, y).

        A mirroring negates the sine, a turn by a rotates by `frequency` a.
        """
        angle = frequency * 2 * np.pi * (np.arange(self.size) % self.turns) / self.turns
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], axis=-2)
        turn[..., 1] *= self.determinants[:, None]
        return turn.round(DECIMALS) + 0.0


@lru_cache
def _named() -> dict[str, Any]:
    return {name: PlanarGroup(int(name[1:]), name[0] == "D") for name in GROUP_NAMES}


def make_group(name: str) -> PlanarGroup:
    """Return the group called `name`, one of `GROUP_NAMES`; D4 is the symmetry of a square."""
    group: PlanarGroup = lookup("--policy.group", name, _named())
    return group


def block_diagonal(blocks: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Join representations (G, d_i, d_i) into one (G, d, d) that moves each block's entries by themselves."""
    size = sum(block.shape[-1] for block in blocks)
    joined = np.zeros((len(blocks[0]), size, size))
    start = 0
    for block in blocks:
        stop = start + block.shape[-1]
        joined[:, start:stop, start:stop] = block
        start = stop
    return joined
