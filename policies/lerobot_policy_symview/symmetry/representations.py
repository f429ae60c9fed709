"""How the dimensions of a state or action vector transform when the scene is rotated or reflected.

The declaration is data, one type per dimension:

| type | meaning | rotation by a | reflection y -> -y | irrep |
|---|---|---|---|---|
| `x`, `y` | horizontal vector, relative to the workspace centre if a position | rotates | negates y | (1, 1) |
| `rx`, `ry` | horizontal part of a rotation vector | rotates | negates rx | (1, 1) x (1, 0) |
| `yaw`, `sign` | angle about the vertical or its increment; any other signed scalar | see below | negates | (1, 0) |
| `z`, `aperture`, `scalar` | any other scalar | keeps | keeps | trivial |

Several dimensions of one type carry a name, `x:left`. An action's `yaw` is an increment, which a rotation of the scene
keeps; a state's `yaw` is the gripper's orientation, to which a rotation adds its angle.
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
from lerobot_policy_symview.symmetry.transforms import PlanarTransform

TYPES = ("x", "y", "rx", "ry", "z", "yaw", "sign", "aperture", "scalar")
PAIRS = {"x": "y", "rx": "ry"}
NAMED = {"tilt": "scalar"}  # of dimensions whose name says their type
REPEATED = ("sign", "scalar")  # types that may occur several times without a name
SMALLEST_EXTENT = 1e-6
MAX_DIMENSIONS = 256
ThetaRepresentation = Literal["sign", "trivial"]


@dataclass(frozen=True)
class VectorRepresentation:
    """The type of every dimension of a vector; see the module.

    Args:
        dimensions: the types, in the order of the dataset's feature.
        flag: the command-line flag that error messages name, such as `--policy.action_symmetry`.

    Raises:
        ValueError: if a type is unknown, occurs twice without a name, or lacks the other half of its vector.
    """

    dimensions: tuple[str, ...]
    flag: str = "the declaration"

    def __post_init__(self) -> None:
        if len(self.dimensions) > MAX_DIMENSIONS:
            raise ValueError(f"{self.flag} has {len(self.dimensions)} dimensions, more than {MAX_DIMENSIONS}")
        unknown = sorted({label for label in self.dimensions if label.split(":")[0] not in TYPES})
        if unknown:
            raise ValueError(f"{self.flag} has unknown types {unknown}, expected any of: {', '.join(TYPES)}")
        for label in self.dimensions:
            kind, _, name = label.partition(":")
            if self.dimensions.count(label) > 1 and kind not in REPEATED:
                raise ValueError(
                    f"{self.flag} has {label!r} more than once: {list(self.dimensions)}; "
                    f"distinguish them by a name, as in '{kind}:left'"
                )
            partner = (PAIRS | {b: a for a, b in PAIRS.items()}).get(kind)
            if partner and _named(partner, name) not in self.dimensions:
                raise ValueError(
                    f"{self.flag} needs both {label!r} and {_named(partner, name)!r} or neither, "
                    f"got {list(self.dimensions)}"
                )

    def check(self, size: int, feature: str, names: Sequence[str] | None = None) -> None:
        """Check the declaration against a feature of the dataset.

        A dimension whose name is a type, or a type after a `d` for an increment, must be declared as that type or as
        `scalar`, which gives up its symmetry. Names of invariant types are interchangeable; others are not checked.

        Args:
            size: number of the feature's dimensions.
            feature: its key.
            names: its dimensions' names, where the dataset has them.

        Raises:
            ValueError: if the number of dimensions differs, or a name contradicts its type.
        """
        if len(self.dimensions) != size:
            called = f" ({', '.join(names)})" if names else ""
            example = ", ".join(_type_of(name) or "scalar" for name in names or ["x", "y", "z", "yaw", "aperture"])
            raise ValueError(
                f"{self.flag} describes {len(self.dimensions)} dimensions, {list(self.dimensions)}; {feature!r} has "
                f"{size}{called}: give one type for each, such as {self.flag}='[{example}]'"
            )
        wrong = [
            f"{name!r} as {label!r}"
            for name, label in zip(names or (), self.dimensions, strict=False)
            if not _can_be(name if name in TYPES else name.removeprefix("d"), label.partition(":")[0])
        ]
        if wrong:
            raise ValueError(
                f"{self.flag} declares {', '.join(wrong)}: {feature!r} is {', '.join(names or ())}, "
                "give the types in this order, or rename the dataset's dimensions if they mean something else"
            )

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """Indices of the two dimensions of each vector, polar and axial."""
        found = []
        for index, label in enumerate(self.dimensions):
            kind, _, name = label.partition(":")
            if kind in PAIRS:
                found.append((index, self.dimensions.index(_named(PAIRS[kind], name))))
        return found

    def of_type(self, kind: str) -> list[int]:
        """Return the indices of the dimensions of a type, with or without a name."""
        return [i for i, label in enumerate(self.dimensions) if label.split(":")[0] == kind]

    @cached_property
    def signs(self) -> list[int]:
        """Indices of the dimensions that a reflection negates."""
        return sorted(self.of_type("yaw") + self.of_type("sign"))

    @cached_property
    def shared_scales(self) -> list[int]:
        """Index, from 0, of every dimension's scale: the two dimensions of a vector share one."""
        first_of = {second: first for first, second in self.pairs}
        leaders = [first_of.get(i, i) for i in range(len(self.dimensions))]
        order = sorted(set(leaders))
        return [order.index(leader) for leader in leaders]

    def is_axial(self, index: int) -> bool:
        """Whether a dimension is part of a rotation vector."""
        return self.dimensions[index].split(":")[0] in ("rx", "ry")

    def select(self, indices: Sequence[int]) -> VectorRepresentation:
        """Return the representation of some dimensions."""
        return VectorRepresentation(tuple(self.dimensions[i] for i in indices), self.flag)

    def matrices(self, group: PlanarGroup, theta: ThetaRepresentation = "sign") -> NDArray[np.float64]:
        """Return the matrices (G, N, N) that transform increments; `trivial` keeps yaw, as the paper's text does."""
        matrices = np.tile(np.eye(len(self.dimensions)), (group.size, 1, 1))
        for pair in self.pairs:
            factor = group.determinants if self.is_axial(pair[0]) else np.ones(group.size)
            matrices[:, np.array(pair)[:, None], pair] = group.rotation() * factor[:, None, None]
        for index in self.signs:
            if theta == "sign" or self.dimensions[index].startswith("sign"):
                matrices[:, index, index] = group.determinants
        return matrices

    def transform(self, values: Tensor, transform: PlanarTransform, absolute_yaw: bool) -> Tensor:
        """Return transformed vectors (B, N); with `absolute_yaw`, `yaw` is an orientation and gains the angle."""
        transformed = values.clone()
        for first, second in self.pairs:
            factor = transform.determinant if self.is_axial(first) else torch.ones_like(transform.determinant)
            x, y = transform.apply(values[:, first], values[:, second])
            transformed[:, first], transformed[:, second] = factor * x, factor * y
        for index in self.signs:
            transformed[:, index] = transform.determinant * values[:, index]
            if absolute_yaw and self.dimensions[index].startswith("yaw"):
                transformed[:, index] += transform.angle
        return transformed

    def scale(self, minimum: Tensor, maximum: Tensor) -> tuple[Tensor, Tensor]:
        """Return centre and half-width (N,) each of a range [minimum, maximum] (N,), by which scaling is equivariant.

        The two dimensions of a vector share a width and have centre zero; so do dimensions that change sign. A
        dimension without extent gets width 1.
        """
        center, width = (minimum + maximum) / 2, (maximum - minimum) / 2
        extent = torch.maximum(minimum.abs(), maximum.abs())
        for pair in self.pairs:
            center[list(pair)] = 0.0
            width[list(pair)] = extent[list(pair)].max()
        for index in self.signs:
            center[index], width[index] = 0.0, extent[index]
        return center, torch.where(width > SMALLEST_EXTENT, width, torch.ones_like(width))


def types_of(names: Sequence[str]) -> list[str] | None:
    """Return the types that the names of dimensions are, or are increments of, such as `dx`; None if any is neither."""
    types = [_type_of(name) for name in names]
    known = [kind for kind in types if kind is not None]
    try:
        VectorRepresentation(tuple(known))
    except ValueError:  # such as an x without a y
        return None
    return known if known and len(known) == len(types) else None


def _type_of(name: str) -> str | None:
    """Return the type that a dimension's name is, or is an increment of; None if it is neither."""
    kinds = (NAMED.get(kind, kind) for kind in (name, name.removeprefix("d")))
    return next((kind for kind in kinds if kind in TYPES), None)


def _can_be(name: str, kind: str) -> bool:
    """Whether a dimension called `name` may be declared as the type `kind`: not if `name` is a different type."""
    return name not in TYPES or kind in (name, "scalar") or {name, kind} <= {"z", "aperture", "scalar"}


def _named(kind: str, name: str) -> str:
    return f"{kind}:{name}" if name else kind
