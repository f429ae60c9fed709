"""How the entries of a state or an action change when the scene is turned or mirrored.

The declaration is data: one kind per entry. `x` and `y` are the two components of a horizontal vector, `yaw` is an
angle about the vertical (an orientation in a state, an increment in an action), `z`, `aperture` and `scalar` do not
change.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

KINDS = ("x", "y", "z", "yaw", "aperture", "scalar")
ThetaRepresentation = Literal["sign", "trivial"]


def check_declaration(name: str, kinds: Sequence[str], size: int | None = None) -> None:
    """Raise a ValueError if `kinds` is not a declaration, or does not describe `size` entries."""
    unknown = sorted(set(kinds) - set(KINDS))
    if unknown:
        raise ValueError(f"--policy.{name} has unknown kinds {unknown}, expected any of: {', '.join(KINDS)}")
    for kind in ("x", "y", "z", "yaw", "aperture"):
        if list(kinds).count(kind) > 1:
            raise ValueError(f"--policy.{name} names {kind!r} more than once: {list(kinds)}")
    if ("x" in kinds) != ("y" in kinds):
        raise ValueError(f"--policy.{name} needs both 'x' and 'y' or neither, got {list(kinds)}")
    if size is not None and len(kinds) != size:
        raise ValueError(f"--policy.{name} describes {len(kinds)} entries, the dataset has {size}")


def turn(values: Tensor, kinds: Sequence[str], angle: Tensor, absolute_yaw: bool) -> Tensor:
    """Return what `values` (B, N) become when the scene turns by `angle` (B,) radians about the workspace centre.

    `absolute_yaw` says whether `yaw` entries are orientations, which turn along, or increments, which do not.
    """
    turned = values.clone()
    if "x" in kinds:
        x, y = kinds.index("x"), kinds.index("y")
        turned[:, x] = torch.cos(angle) * values[:, x] - torch.sin(angle) * values[:, y]
        turned[:, y] = torch.sin(angle) * values[:, x] + torch.cos(angle) * values[:, y]
    if absolute_yaw and "yaw" in kinds:
        turned[:, kinds.index("yaw")] += angle
    return turned


def mirror(values: Tensor, kinds: Sequence[str]) -> Tensor:
    """Return what `values` (B, N) become when the scene is mirrored in the plane y = 0: y and every yaw change sign."""
    signs = values.new_tensor([-1.0 if kind in ("y", "yaw") else 1.0 for kind in kinds])
    return values * signs


def symmetric_range(minimum: Tensor, maximum: Tensor, kinds: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Return centre and half-width (N,), (N,) of a range [minimum, maximum] (N,) that no turn or mirror image leaves.

    Vector components share a width and are centred on zero, and so is yaw; scaling by anything else would not commute
    with the group. An entry without extent gets width 1.
    """
    center = (minimum + maximum) / 2
    width = (maximum - minimum) / 2
    extent = torch.maximum(minimum.abs(), maximum.abs())
    if "x" in kinds:
        vector = [kinds.index("x"), kinds.index("y")]
        center[vector] = 0.0
        width[vector] = extent[vector].max()
    if "yaw" in kinds:
        center[kinds.index("yaw")] = 0.0
        width[kinds.index("yaw")] = extent[kinds.index("yaw")]
    return center, torch.where(width > 1e-6, width, torch.ones_like(width))
