"""Whether a camera has been moved: displacement of the static features between two of its images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Array, Camera, invert_rigid, to_ideal, transform
from lerobot_symview.geometry.visibility import table_resolution
from lerobot_symview.geometry.workspace import Workspace

MOST_FEATURES, QUALITY, SPACING = 500, 0.01, 8  # of Shi and Tomasi's corners; SPACING in pixels
WINDOW, LEVELS = (21, 21), 4  # of the tracker of Lucas and Kanade: motions of up to a hundred pixels
ROUND_TRIP = 0.5  # pixels between a feature and itself, tracked forth and back
CONSENSUS = 1.5  # pixels: features that move with the image, not with objects or the arm
FEWEST, LEAST_SHARE = 20, 0.5  # of features that agree; below, an image tells nothing
PNP_ERROR = 2.0  # pixels
MOST_DRIFT = 2.0  # pixels: features are found to a tenth; a view of 152 pixels shows 2 of 640 as half a pixel


@dataclass(frozen=True, eq=False)
class Drift:
    """Displacement of the static features of a camera's image.

    Args:
        before: (N, 2) float64, their pixels (u, v) in the reference image.
        after: (N, 2) float64, their pixels in the other image.
        share: of the features found in both images, those that are static.
    """

    before: Array
    after: Array
    share: float

    @property
    def pixels(self) -> float:
        """Median length of the displacements."""
        return float(np.median(np.linalg.norm(self.after - self.before, axis=1)))

    def described(self, camera: Camera, workspace: Workspace) -> str:
        """Return the displacement in words: pixels, and how much that is on the table where the image is coarsest."""
        resolution = table_resolution(camera, workspace)
        on_table = f" (up to {self.pixels / resolution:.1f} mm on the table)" if resolution > 0 else ""
        return f"{self.pixels:.1f} pixels{on_table}"


def image_drift(reference: NDArray[np.uint8], image: NDArray[np.uint8]) -> Drift:
    """Track the corners of an image in another one, and keep those that one homography moves.

    A bump turns a camera, which moves its image by a homography; objects and the arm move otherwise.

    Args:
        reference: (H, W, 3) uint8.
        image: (H, W, 3) uint8, of the same camera, later.

    Raises:
        CalibrationError: if fewer than 20 features, or fewer than half of those found in both images, agree.
    """
    first, second = (cv2.cvtColor(one, cv2.COLOR_RGB2GRAY) for one in (reference, image))
    if first.shape != second.shape:
        raise CalibrationError(f"the images have {first.shape} and {second.shape} pixels")
    corners = cv2.goodFeaturesToTrack(first, MOST_FEATURES, QUALITY, SPACING)
    if corners is None or len(corners) < FEWEST:
        raise CalibrationError(f"the reference image has {0 if corners is None else len(corners)} features to follow")
    moved, found, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, winSize=WINDOW, maxLevel=LEVELS)
    back, found_again, _ = cv2.calcOpticalFlowPyrLK(second, first, moved, None, winSize=WINDOW, maxLevel=LEVELS)
    returned = np.linalg.norm((back - corners).reshape(-1, 2), axis=1) < ROUND_TRIP
    kept = (found.ravel() > 0) & (found_again.ravel() > 0) & returned
    before, after = (points.reshape(-1, 2)[kept].astype(np.float64) for points in (corners, moved))
    static = np.zeros(len(before), dtype=bool)
    if len(before) >= FEWEST:
        _, mask = cv2.findHomography(before, after, cv2.RANSAC, CONSENSUS)
        static = static if mask is None else mask.ravel() > 0
    if static.sum() < max(FEWEST, LEAST_SHARE * len(before)):
        raise CalibrationError(
            f"{static.sum()} of the {len(before)} features found in both images agree, expected {FEWEST} and half: the "
            "camera has been moved far, or too little of the image stands still"
        )
    return Drift(before[static], after[static], float(static.mean()))


def moved_camera(camera: Camera, drift: Drift, depth: NDArray[np.floating] | None = None) -> Camera:
    """Return the camera as it stands in the later image of a drift.

    The features' places come from depth, or, without depth, from the table, on which most of them must then lie.

    Args:
        camera: as it stood in the reference image.
        drift: from the reference to the later image.
        depth: (H, W) float, metres, of the reference image; 0, negative or non-finite = invalid.

    Raises:
        CalibrationError: if no pose moves at least half of the features as the image does.
    """
    ideal = to_ideal(drift.before, camera)
    rays = np.column_stack([(ideal - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(ideal))])
    if depth is not None:
        u, v = drift.before.round().astype(int).clip(0, [camera.width - 1, camera.height - 1]).T
        distance = depth[v, u].astype(np.float64)
    else:
        with np.errstate(divide="ignore"):
            distance = -camera.position[2] / (rays @ camera.world_from_cam[2, :3])
    known = np.isfinite(distance) & (distance > 0)
    points = transform(camera.world_from_cam, rays[known] * distance[known, None])
    seen = to_ideal(drift.after[known], camera)
    cam_from_world = _solved(points, seen, camera) if len(points) >= FEWEST else None
    if cam_from_world is None:
        raise CalibrationError("no pose of the camera explains how its image has moved: calibrate it again")
    return replace(camera, world_from_cam=invert_rigid(cam_from_world))


def _solved(points: Array, pixels: Array, camera: Camera) -> Array | None:
    """Return cam_from_world (4, 4) by PnP, from the present pose; None if half of the points disagree."""
    rotation, _ = cv2.Rodrigues(camera.cam_from_world[:3, :3])
    translation = camera.cam_from_world[:3, 3:].copy()
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points, pixels, camera.intrinsics, None, rotation, translation, useExtrinsicGuess=True,
        iterationsCount=300, reprojectionError=PNP_ERROR,
    )  # fmt: skip
    if not found or inliers is None or len(inliers) < LEAST_SHARE * len(points):
        return None
    chosen = inliers.ravel()
    rotation, translation = cv2.solvePnPRefineLM(
        points[chosen], pixels[chosen], camera.intrinsics, None, rotation, translation
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
    return pose
