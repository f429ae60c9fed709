"""Pose and intrinsics of a camera from the corners of a board, with checks that the corners determine them.

A plane has two poses that fit almost equally well when it is small in the image or seen from the front. They are
compared, and a pose that the corners leave open is an error and no result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np

from lerobot_symview.calibration.board_corners import Corners
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.calibration_problems import calibration_problems
from lerobot_symview.geometry.camera import Array, DepthSensor, invert_rigid
from lerobot_symview.geometry.lens import Lens

CORNER_NOISE = 0.1  # pixels: corners in photographs are not located better
LARGE_ERROR = 0.003  # of the image's width: RMS reprojection error beyond which corners and camera disagree
LEAST_ELEVATION = 10.0  # degrees of the camera above the board's plane
SAME_POSE = 0.5  # degrees between two solutions that are one
LEAST_DIFFERENCE = 16.0  # between the squared errors of two poses, in variances of a corner: four standard deviations
MOST_UNCERTAIN = 0.5  # degrees, standard deviation of the board's orientation
LEAST_VIEWS, LEAST_TILT = 5, 15.0  # for intrinsics: images, and degrees between the most different boards
MOST_UNCERTAIN_FOCAL = 0.005  # standard deviation of the focal lengths, relative


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """Intrinsics of a camera.

    Args:
        matrix: (3, 3) float64, K in pixels.
        distortion: (N,) float64, OpenCV's coefficients k1, k2, p1, p2, k3, ...; empty = none.
        fisheye: the lens in place of `distortion`, through which corners are found as ideal pixels.
        depth_sensor: the camera of its depth images; None where these are aligned with colour.
    """

    matrix: Array
    distortion: Array = field(default_factory=lambda: np.zeros(0))
    fisheye: Lens | None = None
    depth_sensor: DepthSensor | None = None


@dataclass(frozen=True, eq=False)
class BoardPose:
    """Pose of a board in the camera's frame.

    Args:
        cam_from_board: (4, 4) float64, metres.
        error_px: RMS reprojection error, pixels.
        error_mm: RMS distance of the corners' rays from the corners, on the board's plane, millimetres.
        uncertainty_deg: standard deviation of the board's orientation about its least certain axis, degrees.
        uncertainty_mm: standard deviation of the board's distance, millimetres.
    """

    cam_from_board: Array
    error_px: float
    error_mm: float
    uncertainty_deg: float
    uncertainty_mm: float


@dataclass(frozen=True, eq=False)
class EstimatedIntrinsics(Intrinsics):
    """Intrinsics estimated from images of a board.

    Args:
        errors_px: image -> RMS reprojection error, pixels.
        uncertainty: standard deviation of the focal lengths, relative.
    """

    errors_px: Mapping[str, float] = field(default_factory=dict)
    uncertainty: float = 0.0


def board_pose(corners: Corners, intrinsics: Intrinsics, width: int) -> BoardPose:
    """Return the pose of a board from its corners in one image.

    Args:
        corners: as `find_board` returns.
        intrinsics: of the camera.
        width: of the image, pixels.

    Raises:
        CalibrationError: if no pose fits, two different ones do, the board is seen edge on, or its orientation is
            uncertain by more than half a degree.
    """
    poses = _candidate_poses(corners, intrinsics)
    if not poses:
        raise CalibrationError("no pose of the board explains its corners: check its columns, rows and the intrinsics")
    best = poses[0]
    errors = [_rms(_residuals(corners, pose, intrinsics)) for pose in poses]
    if errors[0] > LARGE_ERROR * width:
        raise CalibrationError(
            f"the reprojection error is {errors[0]:.2f} pixels, expected at most {LARGE_ERROR * width:.1f}: "
            "check the intrinsics, the lens distortion, the board's columns, rows and marker, and that it is flat"
        )
    elevation = _elevation(best, corners)
    if elevation < LEAST_ELEVATION:
        raise CalibrationError(
            f"the board is seen edge on, {elevation:.0f} degrees above its plane, expected at least "
            f"{LEAST_ELEVATION:.0f}: raise the camera or prop up the board for the intrinsics only"
        )
    noise = max(errors[0] / np.sqrt(2), CORNER_NOISE)  # per coordinate
    for other, error in zip(poses[1:], errors[1:], strict=True):
        angle = _angle_between(best, other)
        difference = len(corners) * (error**2 - errors[0] ** 2) / noise**2
        if angle > SAME_POSE and difference < LEAST_DIFFERENCE:
            raise CalibrationError(
                f"two poses of the board, {angle:.1f} degrees apart, fit its corners, with reprojection errors of "
                f"{errors[0]:.2f} and {error:.2f} pixels: "
                "let it fill more of the image, and face the camera less squarely"
            )
    uncertainty_deg, uncertainty_mm = _uncertainty(corners, best, intrinsics, noise)
    if uncertainty_deg > MOST_UNCERTAIN:
        raise CalibrationError(
            f"the {len(corners)} corners leave the board's orientation uncertain by {uncertainty_deg:.1f} degrees, "
            f"expected at most {MOST_UNCERTAIN:g}: let the board fill more of the image, or use a larger one"
        )
    return BoardPose(best, errors[0], _error_mm(corners, best, intrinsics), uncertainty_deg, uncertainty_mm)


def estimate_intrinsics(views: Mapping[str, Corners], height: int, width: int) -> EstimatedIntrinsics:
    """Return K and the lens distortion k1, k2, p1, p2 from images of a board at different angles.

    Args:
        views: image -> its corners.
        height: rows of the images.
        width: columns of the images.

    Raises:
        CalibrationError: if the images are too few or too similar to determine them, or one contradicts the others.
    """
    if len(views) < LEAST_VIEWS:
        raise CalibrationError(
            f"the intrinsics need at least {LEAST_VIEWS} images that show the board at different angles, "
            f"got {len(views)}: add images, or give the intrinsics"
        )
    points = [corners.board.astype(np.float32) for corners in views.values()]
    pixels = [corners.pixels.astype(np.float32)[:, None] for corners in views.values()]
    try:
        _, matrix, distortion, rotations, _, deviations, _, errors = cv2.calibrateCameraExtended(
            points, pixels, (width, height), None, None, flags=cv2.CALIB_FIX_K3
        )
    except cv2.error as error:
        raise CalibrationError(f"OpenCV finds no intrinsics from these images: {error.err}") from None
    normals = np.stack([cv2.Rodrigues(rotation)[0][:, 2] for rotation in rotations])
    tilt = float(np.rad2deg(np.arccos(np.clip(normals @ normals.T, -1, 1).min())))
    uncertainty = float((deviations[:2, 0] / np.diag(matrix)[:2]).max())
    errors_px = dict(zip(views, errors[:, 0].tolist(), strict=True))
    worst = max(errors_px, key=lambda image: errors_px[image])
    if errors_px[worst] > LARGE_ERROR * width:
        raise CalibrationError(
            f"the reprojection error of {worst} is {errors_px[worst]:.2f} pixels, expected at most "
            f"{LARGE_ERROR * width:.1f}: remove it if it is blurred, or check the board's columns, rows and type"
        )
    if tilt < LEAST_TILT or not uncertainty < MOST_UNCERTAIN_FOCAL:
        raise CalibrationError(
            f"the images do not determine the intrinsics: the boards are tilted by at most {tilt:.0f} degrees to each "
            f"other and the focal length is uncertain by {uncertainty:.1%}, expected at least {LEAST_TILT:.0f} degrees "
            f"and at most {MOST_UNCERTAIN_FOCAL:.1%}: add images in which the board leans to the left, the right, "
            "forward and back, near the image's corners too"
        )
    problems = calibration_problems(matrix, np.eye(4), (height, width))
    if problems:
        raise CalibrationError(f"the images give impossible intrinsics: {'; '.join(problems)}; add images")
    return EstimatedIntrinsics(matrix, distortion.ravel()[:4], errors_px=errors_px, uncertainty=uncertainty)


def world_from_cam(pose: BoardPose, world_from_board: Array) -> Array:
    """Return the camera's pose (4, 4) in the world, given the board's, metres."""
    return world_from_board @ invert_rigid(pose.cam_from_board)


def _candidate_poses(corners: Corners, intrinsics: Intrinsics) -> list[Array]:
    """Return the poses cam_from_board that fit locally, at most two, the best first."""
    camera = (intrinsics.matrix, intrinsics.distortion)
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            corners.board, corners.pixels, *camera, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return []
    poses = []
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-12)
    for rotation, translation in zip(rotations, translations, strict=True):
        if not np.isfinite([rotation, translation]).all():  # IPPE reports success nevertheless
            continue
        rotation, translation = cv2.solvePnPRefineLM(
            corners.board, corners.pixels, *camera, rotation, translation, criteria
        )
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
        if ((corners.board @ pose[:3, :3].T + pose[:3, 3])[:, 2] > 0).all() and _elevation(pose, corners) > 0:
            poses.append(pose)
    return sorted(poses, key=lambda pose: _rms(_residuals(corners, pose, intrinsics)))


def _residuals(corners: Corners, pose: Array, intrinsics: Intrinsics) -> Array:
    """Return the reprojection errors (N, 2), pixels."""
    rotation, _ = cv2.Rodrigues(pose[:3, :3])
    projected, _ = cv2.projectPoints(corners.board, rotation, pose[:3, 3], intrinsics.matrix, intrinsics.distortion)
    residuals: Array = projected[:, 0] - corners.pixels
    return residuals


def _rms(vectors: Array) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _elevation(pose: Array, corners: Corners) -> float:
    """Return the angle of the camera above the board's plane, from the corners' centre, degrees."""
    offset = invert_rigid(pose)[:3, 3] - corners.board.mean(axis=0)
    return float(np.rad2deg(np.arcsin(offset[2] / np.linalg.norm(offset))))


def _angle_between(first: Array, second: Array) -> float:
    rotation, _ = cv2.Rodrigues(first[:3, :3].T @ second[:3, :3])
    return float(np.rad2deg(np.linalg.norm(rotation)))


def _uncertainty(corners: Corners, pose: Array, intrinsics: Intrinsics, noise: float) -> tuple[float, float]:
    """Return standard deviations of orientation (degrees) and distance (mm), from corners with `noise` pixels each.

    The covariance is that of least squares, over rotations about the corners' centre and translations.
    """
    rotated = corners.board @ pose[:3, :3].T
    points = rotated + pose[:3, 3]
    x, y, z = points.T
    zero = np.zeros_like(z)
    fx, fy = intrinsics.matrix[0, 0], intrinsics.matrix[1, 1]
    by_point = np.stack([np.stack([fx / z, zero, -fx * x / z**2], -1), np.stack([zero, fy / z, -fy * y / z**2], -1)], 1)
    arms = rotated - rotated.mean(axis=0)
    by_rotation = np.cross(arms[:, None], by_point)  # d(w x arm) . gradient = w . (arm x gradient)
    jacobian = np.concatenate([by_rotation, by_point], axis=-1).reshape(-1, 6)
    covariance = noise**2 * np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    orientation = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    distance = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
    return float(np.rad2deg(orientation)), float(1000 * distance)


def _error_mm(corners: Corners, pose: Array, intrinsics: Intrinsics) -> float:
    rays = np.ones((len(corners), 3))
    rays[:, :2] = cv2.undistortPoints(corners.pixels[:, None], intrinsics.matrix, intrinsics.distortion)[:, 0]
    board_from_cam = invert_rigid(pose)
    position, directions = board_from_cam[:3, 3], rays @ board_from_cam[:3, :3].T
    on_board = position - directions * (position[2] / directions[:, 2:])
    return 1000 * _rms(on_board - corners.board)
