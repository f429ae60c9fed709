"""The tool's pose as numbers that a table task is about: place, yaw, and how far the gripper leans off the vertical.

    x, y, z   metres, in the base's frame
    yaw       angle about the vertical of the direction in which the fingers open once they are swung straight down, the
              shortest way, radians; modulo pi, because a parallel gripper is symmetric
    tilt      angle of the fingers off straight down, outwards from the arm's first joint, radians
    lean      the same, sideways

An arm of five joints sets all but the lean, which follows from its place.
"""

from __future__ import annotations

import numpy as np

from lerobot_symview.kinematics.model import Array

POSE = ("x", "y", "z", "yaw", "tilt", "lean")
ANGLES = slice(3, 6)
UPWARDS = 0.9  # cosine of the angle to straight up, beyond which there is no shortest way down
NEAR = 0.02  # metres from the vertical through the first joint, within which tilt is undefined


def tool_poses(base_from_tool: Array, pivot: Array) -> Array:
    """Return x, y, z, yaw, tilt and lean (N, 6) of tools.

    Args:
        base_from_tool: (N, 4, 4); the tool's x axis is where the fingers open, its z axis where they point.
        pivot: (2,) x and y of the arm's first joint in the base's frame, metres.
    """
    place, opening, pointing = base_from_tool[:, :3, 3], base_from_tool[:, :3, 0], base_from_tool[:, :3, 2]
    outwards = place[:, :2] - pivot
    distance = np.sqrt((outwards * outwards).sum(axis=1, keepdims=True))
    outwards = np.where(distance > 1e-9, outwards / np.maximum(distance, 1e-9), [1.0, 0.0])
    radial = (pointing[:, :2] * outwards).sum(axis=1)
    sideways = outwards[:, 0] * pointing[:, 1] - outwards[:, 1] * pointing[:, 0]
    # the shortest turn from `pointing` to straight down, about the horizontal axis between them, of `opening`
    across = pointing[:, 0] * opening[:, 1] - pointing[:, 1] * opening[:, 0]
    across /= np.maximum(1.0 - pointing[:, 2], 1e-9)
    x = pointing[:, 0] * opening[:, 2] - pointing[:, 2] * opening[:, 0] - pointing[:, 1] * across
    y = pointing[:, 1] * opening[:, 2] - pointing[:, 2] * opening[:, 1] + pointing[:, 0] * across
    yaw = wrapped(np.arctan2(y, x), np.pi)
    tilt = np.arctan2(radial, -pointing[:, 2])
    lean = np.arctan2(sideways, np.hypot(radial, pointing[:, 2]))
    return np.concatenate([place, np.stack([yaw, tilt, lean], axis=1)], axis=1)


def is_singular(base_from_tool: Array, pivot: Array) -> Array:
    """Return whether yaw or tilt of tools (N, 4, 4) is undefined (N,): fingers point up, or are over the pivot."""
    upwards = base_from_tool[:, 2, 2] > UPWARDS
    near = np.hypot(*(base_from_tool[:, :2, 3] - pivot).T) < NEAR
    return upwards | near


def differences(poses: Array, reference: Array) -> Array:
    """Return poses (N, 6) minus others (N, 6) or one (6,): yaw in [-pi/2, pi/2), tilt and lean in [-pi, pi)."""
    difference = poses - reference
    difference[..., 3] = wrapped(difference[..., 3], np.pi)
    difference[..., 4:] = wrapped(difference[..., 4:], 2 * np.pi)
    return difference


def wrapped(angles: Array, period: float) -> Array:
    """Return angles in [-period / 2, period / 2)."""
    return (angles + period / 2) % period - period / 2
