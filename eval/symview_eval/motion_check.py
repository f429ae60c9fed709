"""Whether a camera's images change where the state says the gripper is, or where it would be in a transformed scene.

A base that is turned against the calibration, or an axis of the wrong sign, is the same in states and actions, which
stay consistent. The images tell: what moves in them is the gripper.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_policy_symview.symmetry.groups import PlanarGroup
from lerobot_symview.geometry.camera import Camera, project
from lerobot_symview.geometry.workspace import Workspace

Array = NDArray[np.float64]

RESAMPLES = 1000
CONFIDENCE = 0.975  # fraction of the resamples in which one transform must be the best
LEAST_SCORE = 0.5  # standard deviations by which the images must change more where the gripper is than at other times
GRIPPER = 0.03  # metres around the gripper's point in which an image changes


@dataclass(frozen=True, eq=False)
class MotionScores:
    """How much more images change at the gripper than there at other times, for each transform of its path.

    Args:
        scores: (E, G) per episode and group element, in standard deviations of an episode's changes.
        group: the transforms.
    """

    scores: Array
    group: PlanarGroup

    @property
    def means(self) -> Array:
        """(G,) the mean scores of all episodes."""
        return self.scores.mean(axis=0)

    def best(self, seed: int = 0) -> int | None:
        """Return the transform after which the path fits the images; None if they do not say it clearly.

        Element 0, the identity, confirms the states.
        """
        drawn = np.random.default_rng(seed).integers(len(self.scores), size=(RESAMPLES, len(self.scores)))
        resampled = self.scores[drawn].mean(axis=1).argmax(axis=1)
        best = int(self.means.argmax())
        is_clear = self.means[best] > LEAST_SCORE and (resampled == best).mean() > CONFIDENCE
        return best if is_clear else None


def motion_scores(
    images: NDArray[np.uint8], points: NDArray[np.float64], camera: Camera, workspace: Workspace, group: PlanarGroup
) -> Array | None:
    """Return how much more images change at the gripper than there at other times (G,); None if nothing moves.

    Args:
        images: (T, H, W, 3) uint8 of one episode, from a camera that stands still.
        points: (T, 3) where the gripper is in them, metres, in the calibration's world.
        camera: the camera of the images.
        workspace: about whose centre the path is transformed.
        group: the transforms of the path.
    """
    depth = project(points, camera)[1]
    if not (depth > 0).all():
        return None
    radius = max(1, round(camera.intrinsics[0, 0] * GRIPPER / float(np.median(depth))))
    window = (2 * radius + 1, 2 * radius + 1)
    pairs = pairwise(images)
    changes = np.stack([cv2.blur(cv2.absdiff(*pair).mean(axis=-1, dtype=np.float32), window) for pair in pairs])
    spread = float(changes.std())
    if spread == 0:
        return None
    center = np.array([*workspace.center, 0.0])
    scores = []
    for matrix in group.rotation():
        moved = points - center
        moved[:, :2] = moved[:, :2] @ matrix.T
        pixels, depth = project(moved + center, camera)
        inside = np.nan_to_num(pixels, posinf=0.0, neginf=0.0).round().clip(0, [camera.width - 1, camera.height - 1])
        columns, rows = inside.astype(int).T
        excess = 0.0
        for ends in (slice(None, -1), slice(1, None)):  # what moves leaves one place and appears at another
            at_places = changes[:, rows[ends], columns[ends]]  # (time, place)
            excess += float(np.diagonal(at_places).mean() - at_places.mean()) / 2
        scores.append(excess / spread)
    return np.array(scores)
