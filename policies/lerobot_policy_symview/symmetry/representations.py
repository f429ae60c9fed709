"""How the entries of a state or an action change when the scene is turned or mirrored.

The declaration is data, one kind per entry:

| kind | meaning | a turn by a | a mirror image (y -> -y) |
|---|---|---|---|
| `x`, `y` | horizontal vector, relative to the workspace centre if a position | rotates | negates y |
| `rx`, `ry` | horizontal part of a rotation vector | rotates | negates rx |
| `yaw`, `sign` | angle about the vertical or its increment; any other signed quantity | see below | negates |
| `z`, `aperture`, `scalar` | anything else | keeps | keeps |

Several of a kind carry a name, `x:left`. An action's `yaw` is an increment, which a turn keeps; a state's `yaw` is the
gripper's orientation, which turns along.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_policy_symview.symmetry.groups import PlanarGroup

KINDS = ("x", "y", "rx", "ry", "z", "yaw", "sign", "aperture", "scalar")
PAIRS = {"x": "y", "rx": "ry"}
REPEATED = ("sign", "scalar")  # kinds that need no name to be there several times
SMALLEST_EXTENT = 1e-6
MOST_ENTRIES = 256
ThetaRepresentation = Literal["sign", "trivial"]


@dataclass(frozen=True)
class Motion:
    """One motion of the scene per sample: mirrored in the plane y = 0 or not, then turned about the workspace centre.

    Args:
        angle: (B,) radians.
        mirrored: (B,) bool.
    """

    angle: Tensor
    mirrored: Tensor

    @classmethod
    def of_element(cls, group: PlanarGroup, element: int, like: Tensor) -> Motion:
        """Return the motion by a group's element for every sample of `like` (B, ...)."""
        angle = like.new_full((len(like),), group.angle(element))
        return cls(angle, torch.full_like(angle, group.flips(element), dtype=torch.bool))

    def repeated(self, times: int) -> Motion:
        """Return the motions of a batch that holds these samples several times over, one after the other."""
        return Motion(self.angle.repeat(times), self.mirrored.repeat(times))

    @property
    def sign(self) -> Tensor:
        """(B,): -1 for mirrored samples, else 1."""
        return 1 - 2 * self.mirrored.to(self.angle.dtype)

    def move(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Move vectors; x and y are (B, ...)."""
        shape = (-1, *[1] * (x.ndim - 1))
        cos, sin = torch.cos(self.angle).view(shape), torch.sin(self.angle).view(shape)
        y = y * self.sign.view(shape)
        return cos * x - sin * y, sin * x + cos * y


@dataclass(frozen=True)
class Symmetry:
    """A declaration of entries; see the module.

    Args:
        entries: a kind per entry, in the order of the dataset's feature.
        flag: how errors name it, such as `--policy.action_symmetry`.
    """

    entries: tuple[str, ...]
    flag: str = "the declaration"

    def __post_init__(self) -> None:
        if len(self.entries) > MOST_ENTRIES:
            raise ValueError(f"{self.flag} has {len(self.entries)} entries, more than {MOST_ENTRIES}")
        unknown = sorted({entry for entry in self.entries if entry.split(":")[0] not in KINDS})
        if unknown:
            raise ValueError(f"{self.flag} has unknown kinds {unknown}, expected any of: {', '.join(KINDS)}")
        for entry in self.entries:
            kind, _, name = entry.partition(":")
            if self.entries.count(entry) > 1 and kind not in REPEATED:
                raise ValueError(
                    f"{self.flag} names {entry!r} more than once: {list(self.entries)}; "
                    f"tell them apart by a name, as in '{kind}:left'"
                )
            partner = (PAIRS | {b: a for a, b in PAIRS.items()}).get(kind)
            if partner and _named(partner, name) not in self.entries:
                raise ValueError(
                    f"{self.flag} needs both {entry!r} and {_named(partner, name)!r} or neither, "
                    f"got {list(self.entries)}"
                )

    def check(self, size: int, feature: str, names: Sequence[str] | None = None) -> None:
        """Raise a ValueError unless `feature`, which has `size` entries called `names`, can be what is declared.

        A name that is a kind, or one after a `d` for an increment, must be declared as that kind or as `scalar`, which
        gives its symmetry up; names of what keeps its value may be declared as any such kind, other names say nothing.
        """
        if len(self.entries) != size:
            called = f" ({', '.join(names)})" if names else ""
            raise ValueError(
                f"{self.flag} describes {len(self.entries)} entries, {list(self.entries)}; {feature!r} has "
                f"{size}{called}: state one kind for each, such as {self.flag}='[x, y, z, yaw, aperture]'"
            )
        wrong = [
            f"{name!r} as {entry!r}"
            for name, entry in zip(names or (), self.entries, strict=False)
            if not _can_be(name if name in KINDS else name.removeprefix("d"), entry.partition(":")[0])
        ]
        if wrong:
            raise ValueError(
                f"{self.flag} declares {', '.join(wrong)}: {feature!r} is {', '.join(names or ())}, "
                "state the kinds in this order, or rename the dataset's entries if they are something else"
            )

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """Indices of the two entries of each vector, polar ones and rotation vectors."""
        found = []
        for index, entry in enumerate(self.entries):
            kind, _, name = entry.partition(":")
            if kind in PAIRS:
                found.append((index, self.entries.index(_named(PAIRS[kind], name))))
        return found

    def of_kind(self, kind: str) -> list[int]:
        """Return the indices of the entries of a kind, with or without a name."""
        return [i for i, entry in enumerate(self.entries) if entry.split(":")[0] == kind]

    @cached_property
    def signs(self) -> list[int]:
        """Indices of the entries that mirror images negate."""
        return sorted(self.of_kind("yaw") + self.of_kind("sign"))

    @cached_property
    def shared_scales(self) -> list[int]:
        """For every entry the number, from 0, of the scale it has: a vector's two entries have one in common."""
        first_of = {second: first for first, second in self.pairs}
        leaders = [first_of.get(i, i) for i in range(len(self.entries))]
        order = sorted(set(leaders))
        return [order.index(leader) for leader in leaders]

    def is_axial(self, index: int) -> bool:
        """Whether an entry is part of a rotation vector."""
        return self.entries[index].split(":")[0] in ("rx", "ry")

    def select(self, indices: Sequence[int]) -> Symmetry:
        """Return the declaration of some entries."""
        return Symmetry(tuple(self.entries[i] for i in indices), self.flag)

    def representation(self, group: PlanarGroup, theta: ThetaRepresentation = "sign") -> NDArray[np.float64]:
        """Return the matrices (G, N, N) that move increments; `trivial` leaves yaw alone, as the paper's text does."""
        matrices = np.tile(np.eye(len(self.entries)), (group.size, 1, 1))
        for pair in self.pairs:
            factor = group.determinants if self.is_axial(pair[0]) else np.ones(group.size)
            matrices[:, np.array(pair)[:, None], pair] = group.rotation() * factor[:, None, None]
        for index in self.signs:
            if theta == "sign" or self.entries[index].startswith("sign"):
                matrices[:, index, index] = group.determinants
        return matrices

    def move(self, values: Tensor, motion: Motion, absolute_yaw: bool) -> Tensor:
        """Return what values (B, N) become; with `absolute_yaw`, `yaw` entries are orientations, which turn along."""
        moved = values.clone()
        for first, second in self.pairs:
            factor = motion.sign if self.is_axial(first) else torch.ones_like(motion.sign)
            x, y = motion.move(values[:, first], values[:, second])
            moved[:, first], moved[:, second] = factor * x, factor * y
        for index in self.signs:
            moved[:, index] = motion.sign * values[:, index]
            if absolute_yaw and self.entries[index].startswith("yaw"):
                moved[:, index] += motion.angle
        return moved

    def scale(self, minimum: Tensor, maximum: Tensor) -> tuple[Tensor, Tensor]:
        """Return centre and half-width (N,), (N,) of a range [minimum, maximum] (N,) that no motion leaves.

        The entries of a vector share a width and are centred on zero, and so is what changes its sign; scaling by
        anything else would not commute with the group. An entry without extent gets width 1.
        """
        center, width = (minimum + maximum) / 2, (maximum - minimum) / 2
        extent = torch.maximum(minimum.abs(), maximum.abs())
        for pair in self.pairs:
            center[list(pair)] = 0.0
            width[list(pair)] = extent[list(pair)].max()
        for index in self.signs:
            center[index], width[index] = 0.0, extent[index]
        return center, torch.where(width > SMALLEST_EXTENT, width, torch.ones_like(width))


def _can_be(name: str, kind: str) -> bool:
    """Whether an entry called `name` may be declared as `kind`: not if it is a kind that moves otherwise."""
    return name not in KINDS or kind in (name, "scalar") or {name, kind} <= {"z", "aperture", "scalar"}


def _named(kind: str, name: str) -> str:
    return f"{kind}:{name}" if name else kind
