"""Cameras that were moved, seen in their images."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lerobot_symview.calibration.drift import image_drift, moved_camera
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera, orbit_pose
from lerobot_symview.geometry.lens import PLUMB_BOB, Lens
from tests.helpers.boards import K, pose_errors
from tests.helpers.cameras import plane_depth
from tests.helpers.tables import TABLE, textured_table

CAMERA = Camera(K, orbit_pose(0.8, 0.3, 0.9, TABLE), 480, 640)


def bumped(camera=CAMERA, turn_deg=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0)):
    """The camera after a turn about its own axes and a shift in metres."""
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.deg2rad(np.array(turn_deg)))[0]
    turn[:3, 3] = shift
    return replace(camera, world_from_cam=camera.world_from_cam @ turn)


@pytest.mark.parametrize("pixels", [0.0, 3.0, 40.0])
def test_a_turn_moves_the_image_by_its_angle(pixels):
    after = bumped(turn_deg=(0.0, np.rad2deg(np.arctan(pixels / K[0, 0])), 0.0))
    drift = image_drift(textured_table(CAMERA, seed=1), textured_table(after, seed=2))
    assert drift.pixels == pytest.approx(pixels, abs=0.2 + 0.05 * pixels)
    assert drift.share > 0.9


def test_objects_that_move_are_no_drift():
    before, after = textured_table(CAMERA, seed=1), textured_table(CAMERA, seed=2)
    object_image = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    before[100:220, 100:260], after[130:250, 160:320] = object_image, object_image
    drift = image_drift(before, after)
    assert drift.pixels < 0.2
    assert drift.share < 1


@pytest.mark.parametrize("lens", [None, Lens(PLUMB_BOB, (-0.2, 0.05, 0.001, -0.001, 0.0))], ids=["pinhole", "lens"])
@pytest.mark.parametrize("has_depth", [True, False], ids=["depth", "table"])
@pytest.mark.parametrize(
    ("turn_deg", "shift"), [((0.3, -0.2, 0.1), (0.0, 0.0, 0.0)), ((0.2, 0.5, -1.0), (0.008, -0.005, 0.01))]
)
def test_the_pose_after_a_bump_is_found(turn_deg, shift, has_depth, lens):
    camera = replace(CAMERA, lens=lens)
    after = bumped(camera, turn_deg, shift)
    before = textured_table(camera, seed=1)
    depth = plane_depth(CAMERA).astype(np.float32) if has_depth and lens is None else None
    found = moved_camera(camera, image_drift(before, textured_table(after, seed=2)), depth)
    degrees, millimetres = pose_errors(after, found.world_from_cam)
    assert degrees < 0.1
    assert millimetres < 2.0
    assert found.lens is lens


def test_an_image_without_features_and_another_scene_tell_nothing():
    grey = np.full((480, 640, 3), 128, np.uint8)
    with pytest.raises(CalibrationError, match="has 0 features"):
        image_drift(grey, grey)
    with pytest.raises(CalibrationError, match="features found in both images agree"):
        image_drift(textured_table(CAMERA), textured_table(CAMERA, texture=5))
    with pytest.raises(CalibrationError, match="pixels"):
        image_drift(grey, grey[:240])


def test_a_pose_that_explains_nothing_is_refused():
    """Depth of another scene: no camera sees these points at these pixels."""
    before = textured_table(CAMERA, seed=1)
    drift = image_drift(before, textured_table(bumped(turn_deg=(0.0, 1.0, 0.0)), seed=2))
    depth = np.random.default_rng(0).uniform(0.3, 3.0, (480, 640)).astype(np.float32)
    mirrored = replace(drift, after=drift.after[::-1])
    with pytest.raises(CalibrationError, match="no pose of the camera explains"):
        moved_camera(CAMERA, mirrored, depth)
