"""Pure functions that the experts share. Each is equivariant to rotations about z and reflections of the scene."""

from __future__ import annotations

import numpy as np

from lerobot_symview.geometry.camera import Array

ALIGNED_YAW = 0.1  # radians


def yaw_difference(yaw_from: float, yaw_to: float, period: float) -> float:
    """Return `yaw_to` - `yaw_from` modulo `period`, in [-period / 2, period / 2), rad.

    The period is the symmetry of the object: pi for the gripper, pi / 2 for a cube.
    """
    return float((yaw_to - yaw_from + period / 2) % period - period / 2)


def motion_to(position: Array, goal: Array, yaw_change: float) -> Array:
    """Return the motion (4,) dx, dy, dz, dyaw that remains to be done; it may take several actions.

    Args:
        position: (3,) the gripper's, metres.
        goal: (3,) metres.
        yaw_change: rotation about z that remains to be done, rad.
    """
    return np.append(np.asarray(goal) - position, yaw_change)


def _limited(displacement: Array, longest: float) -> Array:
    """Shorten a horizontal displacement (2,) to at most `longest` metres per axis; its direction is unchanged."""
    return displacement * min(1.0, longest / max(np.abs(displacement).max(), 1e-9))


def sweep(position: Array, yaw: float, start: Array, end: Array, height: float, step: float) -> Array:
    """Return the remaining motion (4,) of a sweep along the table from `start` to `end`, approached from above `start`.

    The gripper's position alone decides: low and on the line, continue to `end`; above `start`, descend; otherwise, go
    to 10 cm above `start`. The fingers' opening axis stays perpendicular to the sweep.

    Args:
        position: (3,) the gripper's, metres.
        yaw: the gripper's, rad.
        start: (2,) metres.
        end: (2,) metres.
        height: of the gripper above the table during the sweep, metres.
        step: largest motion per axis of an action during the sweep, metres.
    """
    along = (end - start) / np.linalg.norm(end - start)
    yaw_change = yaw_difference(yaw, np.arctan2(along[0], -along[1]), period=np.pi)
    offset = position[:2] - start
    ahead, aside = offset @ along, abs(offset @ np.array([-along[1], along[0]]))
    is_low = position[2] < height + 0.015
    if is_low and aside < 0.02 and ahead > -0.02:
        motion = motion_to(position, np.array([*end, height]), yaw_change)
        motion[:2] = _limited(motion[:2], step)
        return motion
    is_above = np.abs(offset).max() < 0.015 and abs(yaw_change) < ALIGNED_YAW
    return motion_to(position, np.array([*start, height if is_above else height + 0.1]), yaw_change)
