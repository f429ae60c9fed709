"""The table in a depth image: whether unit, pose and table height agree, and which of them would explain it if not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Array, Camera
from lerobot_symview.geometry.units import METRES, unit_name
from lerobot_symview.geometry.visibility import camera_problem, read_differently, table_rays
from lerobot_symview.geometry.workspace import Workspace

CAMERA_UNITS = (1.0, 0.001, 0.0001, 0.00025)  # metres, millimetres, RealSense D405, RealSense L515
RAYS = 5_000  # at most; a subsampled image shows the table as well
NOISE = 0.015  # of depth: the error of a stereo camera at a metre is one or two centimetres
ALLOWED_HEIGHT, ALLOWED_TILT = 0.03, 5.0  # metres and degrees; beyond them the calibration is rejected
REPORTED_HEIGHT, REPORTED_TILT = 0.01, 2.0  # beyond them a warning is given
FEW, SOME, MOST = 0.1, 0.2, 0.5  # fractions of the valid pixels
SPAN = 0.5  # of the workspace's side, along x and y: a smaller plane is an object or a link of the robot
CORRECTED_HEIGHT, CORRECTED_TILT = 0.1, 10.0  # metres and degrees; a calibration that is farther off is another one
LEVELLINGS = 3
TRIES = 100


@dataclass(frozen=True)
class TablePlane:
    """The largest plane in the workspace's part of a depth image.

    Args:
        height: at the workspace's centre, metres above z = 0.
        slope: its rise along x and y, metres per metre.
        share: fraction of the valid pixels that lie on it.
    """

    height: float
    slope: tuple[float, float]
    share: float

    @property
    def tilt(self) -> float:
        """Angle to z = 0, degrees."""
        return float(np.rad2deg(np.arctan(np.hypot(*self.slope))))

    @property
    def deviates(self) -> bool:
        """Whether a calibration with this table should be corrected."""
        return abs(self.height) > REPORTED_HEIGHT or self.tilt > REPORTED_TILT

    def __str__(self) -> str:
        return f"the table lies at z = {100 * self.height:+.1f} cm, tilted by {self.tilt:.1f}°"


@dataclass(frozen=True, eq=False)
class _Rays:
    """Pixels whose rays meet the workspace's square on z = 0, with a measured depth.

    Args:
        directions: (N, 3) world directions of the rays, of depth 1.
        expected: (N,) depth at which they meet the table, metres.
        depth: (N,) measured depth, in its own unit.
        count: number of pixels of the workspace, valid or not.
    """

    directions: Array
    expected: Array
    depth: Array
    count: int

    def on_table(self, unit: float) -> float:
        """Return the fraction of the pixels that lie on z = 0 if depth has this unit."""
        if not len(self.depth):
            return 0.0
        measured = self.depth * unit
        return float((np.abs(measured - self.expected) < NOISE * (1 + self.expected)).mean())


def likely_depth_unit(depth: NDArray, camera: Camera, workspace: Workspace) -> float | None:
    """Return the unit in which a depth image shows the table at z = 0, metres per unit; None if in none.

    Args:
        depth: (H, W) float or integer, of unknown unit; 0, negative or non-finite = invalid.
        camera: its calibration.
        workspace: the square on the table.
    """
    rays = _rays(depth, camera, workspace)
    shares = {unit: rays.on_table(unit) for unit in CAMERA_UNITS}
    best = max(shares, key=lambda unit: shares[unit])
    return best if shares[best] >= FEW else None


def has_depth(depth: NDArray, camera: Camera, workspace: Workspace) -> bool:
    """Whether a pixel of the workspace has a valid depth; arguments as in `check_table`."""
    return len(_rays(depth, camera, workspace).depth) > 0


def check_table(
    depth: NDArray[np.floating], camera: Camera, workspace: Workspace, unit: float = METRES
) -> TablePlane | None:
    """Raise an error if a depth image shows the table elsewhere than the calibration says.

    An image in which the robot or objects hide the table passes.

    Args:
        depth: (H, W) float, metres; 0, negative or non-finite = invalid.
        camera: its calibration.
        workspace: the square on the table.
        unit: metres per unit of the stored depth, from which it was converted; named in the message.

    Returns:
        The table's plane, where it is visible.

    Raises:
        CalibrationError: if most pixels of the workspace lie on a plane that is more than 3 cm from z = 0 or tilted by
            more than 5 degrees, or lie below the table, or if none lies on the table but they would in another unit;
            the message names the likely cause.
    """
    rays = _rays(depth, camera, workspace)
    if len(rays.depth) < max(3, FEW * rays.count):
        return None
    plane = _largest_plane(rays, camera, workspace)
    on_table = rays.on_table(1.0)
    below = float((rays.depth > rays.expected * (1 + ALLOWED_HEIGHT / camera.position[2]) + NOISE).mean())
    elsewhere = plane is not None and plane.share >= MOST and abs(plane.height) > ALLOWED_HEIGHT and on_table < SOME
    tilted = plane is not None and plane.share >= MOST and plane.tilt > ALLOWED_TILT
    if elsewhere or tilted:
        raise CalibrationError(f"{plane}, not at z = 0: {_cause(depth, camera, workspace, rays, unit)}")
    if below >= MOST and on_table < SOME:
        raise CalibrationError(
            f"{below:.0%} of the depth pixels in the workspace lie below the table: "
            f"{_cause(depth, camera, workspace, rays, unit)}"
        )
    if on_table < FEW and (other := _other_unit(rays, unit)) is not None:
        raise CalibrationError(f"no depth pixel lies on the table: {_unit_cause(other, unit)}")
    return plane


def levelled(depth: NDArray[np.floating], camera: Camera, workspace: Workspace) -> tuple[Camera, TablePlane]:
    """Return the camera with the smallest change of its pose that puts the table in a depth image at z = 0.

    The camera is tilted and moved along z; position and direction along the table come from the calibration.

    Args:
        depth: (H, W) float, metres; 0, negative or non-finite = invalid.
        camera: its calibration, to about 10 cm and 10 degrees.
        workspace: the square on the table.

    Returns:
        The camera, and the plane that the table had with the given calibration.

    Raises:
        CalibrationError: if the table is not visible, or farther from z = 0.
    """
    plane = first = _visible_plane(depth, camera, workspace)
    if abs(first.height) > CORRECTED_HEIGHT or first.tilt > CORRECTED_TILT:
        raise CalibrationError(
            f"{first}, more than the {100 * CORRECTED_HEIGHT:.0f} cm and {CORRECTED_TILT:.0f}° that are corrected: "
            f"{_cause(depth, camera, workspace, _rays(depth, camera, workspace), METRES)}"
        )
    for _ in range(LEVELLINGS):  # the corrected pose selects other pixels of the workspace
        camera = replace(camera, world_from_cam=_level_from_plane(plane, workspace) @ camera.world_from_cam)
        plane = _visible_plane(depth, camera, workspace)
    return camera, first


def _visible_plane(depth: NDArray, camera: Camera, workspace: Workspace) -> TablePlane:
    rays = _rays(depth, camera, workspace)
    plane = _largest_plane(rays, camera, workspace) if len(rays.depth) >= max(3, FEW * rays.count) else None
    if plane is None:
        raise CalibrationError(
            "the depth image shows no plane in half of the workspace: is the table free, and the unit of depth right?"
        )
    return plane


def _level_from_plane(plane: TablePlane, workspace: Workspace) -> Array:
    """Return the smallest rigid motion (4, 4) that maps a plane to z = 0: a tilt about a point of it, and a lift."""
    a, b = plane.slope
    normal = np.array([-a, -b, 1.0]) / np.sqrt(1 + a**2 + b**2)
    axis = np.array([normal[1], -normal[0], 0.0])  # normal x up, of length sin(tilt)
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    level_from_plane = np.eye(4)
    level_from_plane[:3, :3] += skew + skew @ skew / (1 + normal[2])
    center = np.array([*workspace.center, plane.height])
    level_from_plane[:3, 3] = [*workspace.center, 0.0] - level_from_plane[:3, :3] @ center
    return level_from_plane


def _rays(depth: NDArray, camera: Camera, workspace: Workspace) -> _Rays:
    step = max(1, int(np.sqrt(depth.size / RAYS)))
    directions, expected, inside = table_rays(camera, workspace, step)
    measured = depth[::step, ::step]
    valid = inside & np.isfinite(measured) & (measured > 0)
    return _Rays(directions[valid], expected[valid], measured[valid].astype(np.float64), int(inside.sum()))


def _largest_plane(rays: _Rays, camera: Camera, workspace: Workspace) -> TablePlane | None:
    """Fit z = a x + b y + c by RANSAC, with x and y relative to the workspace's centre, then by least squares."""
    points = camera.position + rays.depth[:, None] * rays.directions - [*workspace.center, 0.0]
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    tolerance = NOISE * rays.depth
    rng = np.random.default_rng(0)
    best: NDArray[np.bool_] = np.zeros(len(points), dtype=bool)
    for chosen in rng.integers(len(points), size=(TRIES, 3)):
        try:
            plane = np.linalg.solve(design[chosen], points[chosen, 2])
        except np.linalg.LinAlgError:
            continue
        inliers = np.abs(design @ plane - points[:, 2]) < tolerance
        best = inliers if inliers.sum() > best.sum() else best
    low, high = np.percentile(points[best, :2], (5, 95), axis=0) if best.any() else (np.zeros(2), np.zeros(2))
    if best.mean() < SOME or (high - low < SPAN * workspace.size).any():
        return None
    a, b, c = np.linalg.lstsq(design[best], points[best, 2], rcond=None)[0]
    return TablePlane(float(c), (float(a), float(b)), float(best.mean()))


def _cause(depth: NDArray, camera: Camera, workspace: Workspace, rays: _Rays, unit: float) -> str:
    """Return the likely cause: another unit, another reading of the pose, or the pose itself."""
    other_unit = _other_unit(rays, unit)
    if other_unit is not None:
        return _unit_cause(other_unit, unit)
    for changes, other in read_differently(camera).items():
        if camera_problem(other, workspace) is None and _rays(depth, other, workspace).on_table(1.0) >= MOST:
            return f"it would lie there with {' and '.join(changes)}"
    return "check the height and the rotation of the camera's pose, the table's height and the unit of depth"


def _other_unit(rays: _Rays, unit: float) -> float | None:
    """Return the usual unit other than `unit` in which most of the stored depth lies on the table."""
    shares = {other: rays.on_table(other / unit) for other in CAMERA_UNITS if other != unit}
    best = max(shares, key=lambda other: shares[other])
    return best if shares[best] >= MOST else None


def _unit_cause(other: float, unit: float) -> str:
    return f"it would lie there if depth were in {unit_name(other)}, not in {unit_name(unit)}"
