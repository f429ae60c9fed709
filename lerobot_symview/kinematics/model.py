"""An arm as a chain of joints from its base to a tool, and its forward kinematics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.errors import KinematicsError

Array = NDArray[np.float64]
JointKind = Literal["revolute", "prismatic"]
LEAST_JOINTS, MOST_JOINTS = 5, 16


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint of the chain.

    Args:
        name: in the model.
        kind: `revolute`, whose position is an angle in radians, or `prismatic`, metres.
        parent_from_joint: (4, 4) pose at position 0 in the frame after the joint before it; of the first, in the base.
        axis: (3,) unit vector in the joint's frame, about or along which it moves.
        lower: lowest position, radians or metres; -inf for none.
        upper: highest position.
    """

    name: str
    kind: JointKind
    parent_from_joint: Array
    axis: Array
    lower: float
    upper: float


@dataclass(frozen=True, eq=False)
class ArmModel:
    """A chain of joints whose last frame carries a tool.

    Args:
        joints: from the base to the tool.
        last_from_tool: (4, 4) pose of the tool after the last joint. The tool's x axis is the direction in which the
            fingers open, its z axis the one in which they point.
        frame_from_tool: (4, 4) pose of the tool in its frame in the model's file, whose axes and origin may be others.

    Raises:
        KinematicsError: if it has too few or too many joints, or a number that is not finite.
    """

    joints: tuple[Joint, ...]
    last_from_tool: Array
    frame_from_tool: Array = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        if not LEAST_JOINTS <= len(self.joints) <= MOST_JOINTS:
            raise KinematicsError(
                f"an arm needs {LEAST_JOINTS} to {MOST_JOINTS} joints between base and tool to set position, yaw and "
                f"tilt, got {len(self.joints)}: {', '.join(self.names) or 'none'}"
            )
        for joint in self.joints:
            if not joint.lower < joint.upper:
                raise KinematicsError(f"the joint {joint.name!r} has limits from {joint.lower} to {joint.upper}")
            if not np.isfinite([*joint.parent_from_joint.ravel(), *joint.axis]).all():
                raise KinematicsError(f"the joint {joint.name!r} has a pose or an axis that is not finite")
            if abs(np.linalg.norm(joint.axis) - 1) > 1e-6:
                raise KinematicsError(f"the axis of the joint {joint.name!r} has no unit length: {joint.axis}")
        if not np.isfinite(self.last_from_tool).all():
            raise KinematicsError("the pose of the tool is not finite")

    @property
    def names(self) -> list[str]:
        """Names of the joints."""
        return [joint.name for joint in self.joints]

    @cached_property
    def lower(self) -> Array:
        """Lowest positions (J,)."""
        return np.array([joint.lower for joint in self.joints])

    @cached_property
    def upper(self) -> Array:
        """Highest positions (J,)."""
        return np.array([joint.upper for joint in self.joints])

    @cached_property
    def is_revolute(self) -> NDArray[np.bool_]:
        """Whether each joint turns (J,)."""
        return np.array([joint.kind == "revolute" for joint in self.joints])

    @cached_property
    def pivot(self) -> Array:
        """The first joint's x and y in the base's frame (2,), metres: an arm reaches outwards from there."""
        return self.joints[0].parent_from_joint[:2, 3]

    @cached_property
    def _terms(self) -> tuple[Array, Array, Array]:
        """The parts of each joint's transform (J, 4, 4): constant, and times two functions of its position."""
        constant = np.stack([joint.parent_from_joint for joint in self.joints])
        first, second = np.zeros_like(constant), np.zeros_like(constant)
        for index, joint in enumerate(self.joints):
            if joint.kind == "revolute":  # Rodrigues: R = I + sin(q) K + (1 - cos(q)) K^2
                x, y, z = joint.axis
                cross = np.zeros((4, 4))
                cross[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
                first[index], second[index] = constant[index] @ cross, constant[index] @ cross @ cross
            else:
                first[index, :3, 3] = constant[index, :3, :3] @ joint.axis
        return constant, first, second

    def forward(self, positions: NDArray[np.floating]) -> Array:
        """Return base_from_tool (N, 4, 4) of joint positions (N, J), radians and metres."""
        positions = np.asarray(positions, dtype=np.float64)
        constant, first, second = self._terms
        along = np.where(self.is_revolute, np.sin(positions), positions)[..., None, None]
        versine = np.where(self.is_revolute, 1 - np.cos(positions), 0.0)[..., None, None]
        moved = constant + along * first + versine * second
        base_from_joint = moved[:, 0]
        for index in range(1, len(self.joints)):
            base_from_joint = base_from_joint @ moved[:, index]
        return base_from_joint @ self.last_from_tool

    def plain(self) -> dict[str, Any]:
        """Return the chain as JSON types, from which `model_from_plain` makes it again; no limit is null."""
        return {
            "joints": [
                {
                    "name": joint.name,
                    "kind": joint.kind,
                    "parent_from_joint": joint.parent_from_joint.tolist(),
                    "axis": joint.axis.tolist(),
                    "lower": joint.lower if np.isfinite(joint.lower) else None,
                    "upper": joint.upper if np.isfinite(joint.upper) else None,
                }
                for joint in self.joints
            ],
            "last_from_tool": self.last_from_tool.tolist(),
            "frame_from_tool": self.frame_from_tool.tolist(),
        }


def model_from_plain(content: Mapping[str, Any]) -> ArmModel:
    """Return the chain that `ArmModel.plain` described.

    Raises:
        KinematicsError: if the content is malformed.
    """
    try:
        joints = tuple(
            Joint(
                str(entry["name"]),
                _kind(entry["kind"]),
                np.array(entry["parent_from_joint"], dtype=np.float64).reshape(4, 4),
                np.array(entry["axis"], dtype=np.float64).reshape(3),
                -np.inf if entry["lower"] is None else float(entry["lower"]),
                np.inf if entry["upper"] is None else float(entry["upper"]),
            )
            for entry in content["joints"]
        )
        last_from_tool = np.array(content["last_from_tool"], dtype=np.float64).reshape(4, 4)
        return ArmModel(joints, last_from_tool, np.array(content["frame_from_tool"], dtype=np.float64).reshape(4, 4))
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, KinematicsError):
            raise
        raise KinematicsError(f"a stored arm is malformed: {type(error).__name__} {error}") from None


def _kind(name: Any) -> JointKind:
    if name == "revolute" or name == "prismatic":
        return name
    raise KinematicsError(f"a joint must be revolute or prismatic, got {name!r}")
