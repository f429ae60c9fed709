"""A camera's pose from the robot's own motions: a point on the gripper, seen at several poses of the gripper.

The point's place on the gripper need not be known, unless the gripper turns about one axis only: then its place along
this axis cannot be told from the camera's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Array, Camera, invert_rigid, to_ideal

FEWEST = 8  # poses of the gripper that agree
LEAST_SHARE = 0.5  # of the poses that agree
START_ERROR = 0.15  # of the image's width: the point may be a decimetre beside the gripper's origin
INLIER_PIXELS, DEVIATIONS = 2.0, 4.0  # a pose is an outlier beyond both: pixels, and times the median error
LEAST_TURN = 0.05  # a turn by 3 degrees: below, a direction of the point on the gripper is not observable
MOST_UNCERTAIN_DEG, MOST_UNCERTAIN_MM = 0.5, 10.0
LEAST_NOISE = 0.3  # pixels, of a point found in an image
MOST_ERROR = 0.05  # of the image's width: 3 cm at 1 m, more than the kinematics of a cheap arm are wrong
ROUNDS = 10


@dataclass(frozen=True, eq=False)
class HandEye:
    """A camera's pose by a point on the gripper.

    Args:
        camera: at its pose.
        point: (3,) the point's place in the gripper's frame, metres.
        used: (N,) bool, the poses of the gripper that agree.
        errors_px: (N,) distance between the point and its projection, pixels.
        errors_mm: (N,) the same at the point's distance, millimetres.
        uncertainty_deg: standard deviation of the camera's orientation.
        uncertainty_mm: standard deviation of its position.
        fixed: (3,) unit vector in the gripper's frame along which the point's place was taken as given; None if all of
            it was determined.
    """

    camera: Camera
    point: Array
    used: NDArray[np.bool_]
    errors_px: Array
    errors_mm: Array
    uncertainty_deg: float
    uncertainty_mm: float
    fixed: Array | None


def hand_eye(camera: Camera, world_from_gripper: Array, pixels: Array, point: ArrayLike = (0.0, 0.0, 0.0)) -> HandEye:
    """Return the pose with which a camera sees a point of the gripper where it does.

    Wrong detections and poses that were recorded at another time are left out, as long as they are fewer than half.

    Args:
        camera: its intrinsics and lens; its pose is not used.
        world_from_gripper: (N, 4, 4), metres.
        pixels: (N, 2), where the camera sees the point.
        point: (3,) its place in the gripper's frame, metres, where the motions do not determine it.

    Raises:
        CalibrationError: if fewer than 8 poses, or fewer than half, agree, or they leave the camera's pose uncertain.
    """
    turns, places = world_from_gripper[:, :3, :3], world_from_gripper[:, :3, 3]
    given, ideal = np.asarray(point, dtype=np.float64), to_ideal(pixels, camera)
    start = _start(camera, places + turns @ given, ideal)
    basis, fixed = _observable(turns)
    used = np.ones(len(pixels), dtype=bool)
    for _ in range(ROUNDS):
        solved = least_squares(
            _residuals, start, args=(camera, turns[used], places[used], ideal[used], given, basis), loss="soft_l1"
        )
        start = solved.x
        errors = np.linalg.norm(_residuals(start, camera, turns, places, ideal, given, basis).reshape(-1, 2), axis=1)
        limit = max(INLIER_PIXELS, DEVIATIONS * float(np.median(errors)))
        agree = errors <= min(limit, MOST_ERROR * camera.width)
        if agree.sum() < max(FEWEST, LEAST_SHARE * len(pixels)):
            raise CalibrationError(
                f"{agree.sum()} of the {len(pixels)} poses of the gripper agree, expected {FEWEST} and half: check the "
                "intrinsics, the order and units of the poses, and that images and poses are of the same time"
            )
        if (agree == used).all():
            break
        used = agree
    solved = least_squares(_residuals, start, args=(camera, turns[used], places[used], ideal[used], given, basis))
    noise = max(float(np.sqrt(np.mean(solved.fun**2))), LEAST_NOISE)
    jacobian = np.asarray(solved.jac)
    spread = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian))) * noise
    degrees, millimetres = np.rad2deg(np.linalg.norm(spread[:3])), 1000 * np.linalg.norm(spread[3:6])
    if not (degrees <= MOST_UNCERTAIN_DEG and millimetres <= MOST_UNCERTAIN_MM):
        raise CalibrationError(
            f"the poses of the gripper leave the camera's uncertain by {degrees:.1f} degrees and {millimetres:.0f} mm, "
            f"expected at most {MOST_UNCERTAIN_DEG:g} and {MOST_UNCERTAIN_MM:g}: move it through more of the "
            "workspace, to different heights too"
        )
    cam_from_world, offset = _unpacked(solved.x, given, basis)
    errors = np.linalg.norm(_residuals(solved.x, camera, turns, places, ideal, given, basis).reshape(-1, 2), axis=1)
    depth = (cam_from_world[:3, :3] @ (places + turns @ offset).T).T[:, 2] + cam_from_world[2, 3]
    posed = replace(camera, world_from_cam=invert_rigid(cam_from_world))
    return HandEye(
        posed, offset, used, errors, 1000 * errors * depth / camera.fx, float(degrees), float(millimetres), fixed
    )


def _start(camera: Camera, points: Array, ideal: Array) -> Array:
    """Return cam_from_world as a rotation vector and a translation, then zeros for the point, by PnP."""
    found = False
    if len(points) >= FEWEST:
        found, rotation, translation, _ = cv2.solvePnPRansac(
            points, ideal, camera.intrinsics, None, flags=cv2.SOLVEPNP_SQPNP, iterationsCount=1000,
            reprojectionError=START_ERROR * camera.width,
        )  # fmt: skip
    if not found:
        raise CalibrationError(
            f"no pose of the camera explains where it sees the gripper, in {len(points)} poses, expected {FEWEST}: "
            "move it to different places and heights"
        )
    return np.concatenate([rotation.ravel(), translation.ravel(), np.zeros(3)])


def _observable(turns: Array) -> tuple[Array, Array | None]:
    """Return the directions in the gripper's frame along which the point's place can be told: (3, 3), and the one not.

    A direction that no turn moves shifts all points alike, as another place of the camera does.
    """
    moved = (turns - turns.mean(axis=0)).reshape(-1, 3)
    _, sizes, directions = np.linalg.svd(moved, full_matrices=False)
    is_seen = sizes / np.sqrt(len(turns)) > LEAST_TURN
    basis: Array = directions.T * is_seen
    return basis, None if is_seen.all() else directions[-1]


def _unpacked(parameters: Array, given: Array, basis: Array) -> tuple[Array, Array]:
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = Rotation.from_rotvec(parameters[:3]).as_matrix()
    cam_from_world[:3, 3] = parameters[3:6]
    return cam_from_world, given + basis @ parameters[6:]


def _residuals(
    parameters: Array, camera: Camera, turns: Array, places: Array, ideal: Array, given: Array, basis: Array
) -> Array:
    cam_from_world, offset = _unpacked(parameters, given, basis)
    points = (places + turns @ offset) @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    depth = np.where(np.abs(points[:, 2]) > 1e-6, points[:, 2], 1e-6)
    projected = points[:, :2] / depth[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return (projected - ideal).ravel()
