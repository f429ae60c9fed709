"""Reads the frames of a URDF; meshes and masses are not needed."""

from __future__ import annotations

from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import numpy as np

from lerobot_symview.errors import KinematicsError
from lerobot_symview.kinematics.chain import Edge, FrameTree, unit
from lerobot_symview.kinematics.model import Array

KINDS: dict[str, Literal["fixed", "revolute", "prismatic"]] = {
    "fixed": "fixed",
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
}
LARGEST = 2**25  # bytes


def read_urdf(file: Path) -> FrameTree:
    """Return the frames of a URDF.

    Raises:
        KinematicsError: if the file is missing, is no URDF, or has a joint that is neither fixed, revolute nor
            prismatic.
    """
    try:
        text = file.read_bytes()
    except OSError as error:
        raise KinematicsError(f"cannot read {file}: {error}") from None
    if len(text) > LARGEST or b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise KinematicsError(f"{file} is larger than 32 MiB or declares entities, which a URDF does not need")
    try:
        robot = ElementTree.fromstring(text)  # noqa: S314  without entities nothing expands
    except ElementTree.ParseError as error:
        raise KinematicsError(f"{file} is no XML: {error}") from None
    if robot.tag != "robot":
        hint = ": it is MJCF" if robot.tag == "mujoco" else ""
        raise KinematicsError(f"{file} is no URDF, its root is <{robot.tag}>{hint}")
    joints = robot.findall("joint")
    if not joints:
        raise KinematicsError(f"{file} has no joints")
    try:
        return FrameTree(tuple(_edge(joint) for joint in joints))
    except (ValueError, AttributeError) as error:
        raise KinematicsError(f"{file}: {error}") from None


def _edge(joint: ElementTree.Element) -> Edge:
    name, kind = joint.get("name", ""), joint.get("type", "")
    if kind not in KINDS:
        raise KinematicsError(f"the joint {name!r} has type {kind!r}, expected one of {', '.join(KINDS)}")
    parent, child = (joint.find(end) for end in ("parent", "child"))
    if parent is None or child is None:
        raise KinematicsError(f"the joint {name!r} lacks its parent or child")
    origin, axis = joint.find("origin"), joint.find("axis")
    pose = np.eye(4)
    if origin is not None:
        pose[:3, :3] = _rotation(*_numbers(origin.get("rpy", "0 0 0"), name))
        pose[:3, 3] = _numbers(origin.get("xyz", "0 0 0"), name)
    direction = np.array([1.0, 0.0, 0.0])
    if KINDS[kind] != "fixed" and axis is not None:
        direction = unit(_numbers(axis.get("xyz", "1 0 0"), name), name)
    limit, mimic = joint.find("limit"), joint.find("mimic")
    lower, upper = -np.inf, np.inf
    if limit is not None and kind in ("revolute", "prismatic"):
        lower, upper = float(limit.get("lower", 0)), float(limit.get("upper", 0))
    return Edge(
        parent.get("link", ""),
        child.get("link", ""),
        name,
        KINDS[kind],
        pose,
        direction,
        lower,
        upper,
        None if mimic is None else mimic.get("joint"),
    )


def _numbers(text: str, joint: str) -> Array:
    numbers = np.array([float(part) for part in text.split()])
    if numbers.shape != (3,):
        raise KinematicsError(f"the joint {joint!r} has {text!r} where three numbers belong")
    return numbers


def _rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Return the matrix (3, 3) of URDF's angles, about the fixed axes x, y, z in this order."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
