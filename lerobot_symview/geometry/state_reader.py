"""States of other conventions read as ours: LeRobot's end-effector names, and positions that count from elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import array_api_compat

from lerobot_symview.geometry.gripper_state import POSE, REQUIRED
from lerobot_symview.geometry.workspace import Workspace

StateOrigin = Literal["workspace", "world", "base"]
ORIGINS: tuple[StateOrigin, ...] = ("workspace", "world", "base")
# LeRobot's names of an end effector: a rotation vector, and the opening in per cent.
END_EFFECTOR = ("ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz", "ee.gripper_pos")
FULLY_OPEN = 100.0


def is_end_effector(names: Sequence[str]) -> bool:
    """Whether a state has LeRobot's names of an end effector's pose."""
    return set(END_EFFECTOR) <= set(names)


def origin_of(
    kind: StateOrigin | None, names: Sequence[str], workspace: Workspace, origin_height: float = 0.0
) -> tuple[float, float, float]:
    """Return the workspace's centre on the table in the frame in which a state's positions are given, metres.

    Args:
        kind: what positions count from; by default the robot's base for LeRobot's names of an end effector, else the
            workspace's centre.
        names: of the state's dimensions.
        workspace: the square on the table.
        origin_height: height above the table of what positions count from, metres.
    """
    kind = kind or ("base" if is_end_effector(names) else "workspace")
    if kind == "workspace":
        return (0.0, 0.0, 0.0)
    return (*workspace.center, -origin_height)


@dataclass(frozen=True)
class StateReader:
    """Reads states as x, y, z relative to the workspace's centre on the table, yaw, aperture, and what else they have.

    Args:
        names: of the state's dimensions.
        origin: as `origin_of` returns it.
    """

    names: tuple[str, ...]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def converts(self) -> bool:
        """Whether a state differs from what is read."""
        return is_end_effector(self.names) or any(self.origin)

    @property
    def others(self) -> list[int]:
        """Indices of the dimensions that are kept unchanged after an end effector's pose."""
        return [index for index, name in enumerate(self.names) if name not in END_EFFECTOR]

    @property
    def read_names(self) -> list[str]:
        """Names of the dimensions of a state that was read."""
        if not is_end_effector(self.names):
            return list(self.names)
        return [*POSE, *(self.names[index] for index in self.others)]

    def read_range(self, values: Any) -> Any:
        """Return the ends of ranges (N,) as `read` orders them; those of an end effector's pose are 0."""
        if not is_end_effector(self.names):
            return values
        xp = array_api_compat.array_namespace(values)
        return xp.concat([xp.zeros_like(values[: len(POSE)]), values[self.others]], axis=-1)

    def read(self, states: Any) -> Any:
        """Return states (..., N) as they are read: (..., len(read_names)), same array type and dtype.

        Args:
            states: numpy array or torch tensor in the order of `names`. A rotation vector is that of the gripper's
                frame, radians; the yaw is its x axis's angle about the vertical.
        """
        xp = array_api_compat.array_namespace(states)
        dtype = states.dtype
        states = xp.astype(states, xp.float64)  # NumPy and PyTorch round float32 functions differently
        if is_end_effector(self.names):
            x, y, z, *rotation, opening = (states[..., self.names.index(name)] for name in END_EFFECTOR)
            pose = xp.stack([x, y, z, heading(*rotation), opening / FULLY_OPEN], axis=-1)
            states = xp.concat([pose, states[..., self.others]], axis=-1)
        columns = {name: index for index, name in enumerate(self.read_names)}
        shift = xp.zeros_like(states)
        for name, offset in zip(REQUIRED, self.origin, strict=True):
            if name in columns:
                shift[..., columns[name]] = offset
        return xp.astype(states - shift, dtype)


def heading(wx: Any, wy: Any, wz: Any) -> Any:
    """Return the angle about the vertical of the rotated x axis, radians; 0 if it is vertical.

    Args:
        wx: (...) first number of the rotation vector, radians.
        wy: (...) second number.
        wz: (...) third number.
    """
    xp = array_api_compat.array_namespace(wx)
    angle_squared = wx * wx + wy * wy + wz * wz
    is_small = angle_squared < 1e-12
    angle = xp.sqrt(xp.where(is_small, xp.ones_like(wx), angle_squared))
    # Rodrigues: R = cos I + (sin / angle) [w] + ((1 - cos) / angle^2) w w^T, and its limits at 0
    sine = xp.where(is_small, xp.ones_like(wx), xp.sin(angle) / angle)
    versine = xp.where(is_small, xp.full_like(wx, 0.5), (1 - xp.cos(angle)) / (angle * angle))
    cosine = xp.where(is_small, xp.ones_like(wx), xp.cos(angle))
    return xp.atan2(sine * wz + versine * wx * wy, cosine + versine * wx * wx)
