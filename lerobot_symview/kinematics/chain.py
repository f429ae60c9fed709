"""The chain from a robot's base to its tool, out of the tree of frames that a model file describes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lerobot_symview.errors import KinematicsError
from lerobot_symview.kinematics.model import ArmModel, Array, Joint, JointKind
from lerobot_symview.registry import check_name

AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
VERTICAL = 0.1  # least sine of the angle between pointing and opening


@dataclass(frozen=True, eq=False)
class Edge:
    """One frame of the tree in its parent.

    Args:
        parent: name of the parent frame.
        child: name of the frame.
        joint: name of the joint between them, or of what fixes them.
        kind: how it moves.
        parent_from_child: (4, 4) at position 0.
        axis: (3,) of the motion, in the child's frame.
        lower: lowest position, radians or metres.
        upper: highest position.
        follows: name of a joint that this one mimics; None for a joint of its own.
    """

    parent: str
    child: str
    joint: str
    kind: JointKind | Literal["fixed"]
    parent_from_child: Array
    axis: Array
    lower: float = -np.inf
    upper: float = np.inf
    follows: str | None = None


@dataclass(frozen=True)
class FrameTree:
    """The frames of a robot's model, by the edges to their parents."""

    edges: tuple[Edge, ...]

    @property
    def joints(self) -> dict[str, Edge]:
        """Edges that move, by the names of their joints."""
        return {edge.joint: edge for edge in self.edges if edge.kind != "fixed"}

    def path(self, frame: str) -> list[Edge]:
        """Return the edges from the root to a frame.

        Raises:
            KinematicsError: if there is no such frame, or the edges are no tree.
        """
        above = {edge.child: edge for edge in self.edges}
        frames = dict.fromkeys([*above, *(edge.parent for edge in self.edges)])
        if frame not in frames:
            _check("frame", frame, frames)
        path: list[Edge] = []
        while frame in above:
            path.insert(0, above[frame])
            frame = above[frame].parent
            if len(path) > len(self.edges):
                raise KinematicsError(f"the frames of the model are no tree: {frame!r} is its own ancestor")
        return path

    def at_zero(self, path: Iterable[Edge]) -> Array:
        """Return the pose (4, 4) of the last frame of a path in the first one's parent, all joints at 0."""
        pose = np.eye(4)
        for edge in path:
            pose = pose @ edge.parent_from_child
        return pose


def arm_chain(
    tree: FrameTree,
    tool_frame: str,
    approach: str = "z",
    opening: str | None = None,
    gripper: str | None = None,
    tool_offset: float = 0.0,
) -> ArmModel:
    """Return the arm from the root of a model to a frame of it.

    Args:
        tree: the model.
        tool_frame: frame between the fingers.
        approach: its axis in which the fingers point, such as `z` or `-x`.
        opening: its axis along which the fingers open; by default, of `gripper`: the direction of a prismatic joint,
            and the one that a revolute joint moves a finger in.
        gripper: joint of the gripper.
        tool_offset: metres from that frame, in the direction in which the gripper opens, to the middle between the
            fingers, which is the tool.

    Raises:
        KinematicsError: if a name is unknown, a joint mimics another one, or the fingers' directions are unknown.
    """
    path = tree.path(tool_frame)
    joints, pending = [], np.eye(4)
    for edge in path:
        pending = pending @ edge.parent_from_child
        if edge.kind == "fixed":
            continue
        if edge.follows is not None:
            raise KinematicsError(f"the joint {edge.joint!r} mimics {edge.follows!r}: such arms are not supported")
        joints.append(Joint(edge.joint, edge.kind, pending, edge.axis, edge.lower, edge.upper))
        pending = np.eye(4)
    arm = ArmModel(tuple(joints), pending)
    for name, axis in (("approach", approach), ("opening", opening)):
        if axis is not None and axis not in AXES:
            raise KinematicsError(f"{name} must be one of {', '.join(AXES)}, got {axis!r}")
    forwards = np.array(AXES[approach], dtype=np.float64)
    sidewards = np.array(AXES[opening], dtype=np.float64) if opening else _opening(tree, path, gripper, forwards)
    sidewards = sidewards - forwards * (sidewards @ forwards)
    if np.linalg.norm(sidewards) < VERTICAL:
        raise KinematicsError(
            f"the fingers would open in the direction in which they point, {approach} of {tool_frame}"
        )
    sidewards /= np.linalg.norm(sidewards)
    axes = np.eye(4)
    axes[:3, :3] = np.stack([sidewards, np.cross(forwards, sidewards), forwards], axis=1)
    axes[:3, 3] = tool_offset * sidewards
    return replace(arm, last_from_tool=pending @ axes, frame_from_tool=axes)


def _opening(tree: FrameTree, tool_path: list[Edge], gripper: str | None, approach: Array) -> Array:
    """Return the direction (3,) in which a gripper's joint moves a finger, in the tool's frame."""
    if gripper is None or gripper not in tree.joints:
        known = ", ".join(tree.joints)
        raise KinematicsError(
            f"the model has no joint {gripper!r} that says in which direction the fingers open; it has {known}: name "
            "the gripper's joint, or the axis of the tool's frame, as opening"
        )
    edge = tree.joints[gripper]
    finger_path = tree.path(edge.child)
    if edge in tool_path or [one for one in finger_path[:-1] if one.kind != "fixed"] != [
        one for one in tool_path if one.kind != "fixed"
    ]:
        raise KinematicsError(
            f"the gripper's joint {gripper!r} must move a finger beside the tool's frame, not the arm"
        )
    base_from_tool, base_from_finger = tree.at_zero(tool_path), tree.at_zero(finger_path)
    axis = base_from_tool[:3, :3].T @ base_from_finger[:3, :3] @ edge.axis
    if edge.kind == "revolute":
        axis = np.cross(axis, approach).astype(np.float64)
    return axis


def _check(kind: str, name: str, known: Iterable[str]) -> None:
    try:
        check_name(f"{kind} of the model", name, known)
    except ValueError as error:
        raise KinematicsError(str(error)) from None


def unit(axis: Array, joint: str) -> Array:
    """Return an axis (3,) with length 1.

    Raises:
        KinematicsError: if it has no length.
    """
    length = float(np.linalg.norm(axis))
    if not 0 < length < np.inf:
        raise KinematicsError(f"the axis of the joint {joint!r} is {axis.tolist()}, expected a direction")
    return axis / length
