"""The pose of a camera by a point on the gripper."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_symview.calibration.hand_eye import hand_eye
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera, orbit_pose, project
from lerobot_symview.geometry.lens import PLUMB_BOB, Lens
from tests.helpers.boards import K, pose_errors

POINT = np.array([0.03, -0.01, 0.05])


def camera_at(azimuth=0.4, lens=None):
    return Camera(K, orbit_pose(0.7, azimuth, 0.9, (0.4, 0.0, 0.1)), 480, 640, lens)


def motions(count=30, seed=0, tilt=0.5, spread=(0.15, 0.15, 0.1)):
    """Poses of a gripper that points down, turned by any yaw and tilted by up to `tilt` radians."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    tilts = Rotation.from_rotvec(np.column_stack([rng.uniform(-tilt, tilt, (count, 2)), np.zeros(count)]))
    yaws = Rotation.from_rotvec(rng.uniform(-np.pi, np.pi, (count, 1)) * [0, 0, 1])
    poses[:, :3, :3] = (tilts * yaws * Rotation.from_rotvec([np.pi, 0, 0])).as_matrix()
    poses[:, :3, 3] = [0.4, 0.0, 0.15] + rng.uniform(-1, 1, (count, 3)) * spread
    return poses


def seen(camera, poses, noise=0.3, seed=1, point=POINT):
    points = poses[:, :3, 3] + poses[:, :3, :3] @ point
    return project(points, camera)[0] + noise * np.random.default_rng(seed).normal(size=(len(poses), 2))


@pytest.mark.parametrize("lens", [None, Lens(PLUMB_BOB, (-0.2, 0.05, 0.001, -0.001, 0.0))], ids=["pinhole", "lens"])
@pytest.mark.parametrize("seed", range(4))
def test_pose_and_point_are_found_from_motions_with_tilts(seed, lens):
    camera, poses = camera_at(azimuth=seed, lens=lens), motions(seed=seed)
    found = hand_eye(camera_at(2.0, lens), poses, seen(camera, poses, seed=seed))
    degrees, millimetres = pose_errors(camera, found.camera.world_from_cam)
    assert degrees < 0.3
    assert millimetres < 5
    assert np.linalg.norm(found.point - POINT) < 0.003
    assert found.used.all()
    assert found.fixed is None
    assert found.errors_mm[found.used].mean() < 1.5


def test_wrong_detections_and_poses_are_left_out():
    camera, poses = camera_at(), motions(40)
    pixels = seen(camera, poses)
    pixels[:12] += np.random.default_rng(2).uniform(30, 200, (12, 2))
    found = hand_eye(camera, poses, pixels)
    assert (found.used == (np.arange(40) >= 12)).all()
    degrees, millimetres = pose_errors(camera, found.camera.world_from_cam)
    assert degrees < 0.3
    assert millimetres < 5
    assert found.errors_mm[:12].min() > 20


def test_a_gripper_that_never_tilts_leaves_the_height_of_the_point_to_the_user():
    """Along the axis of all turns, another place of the point is another place of the camera."""
    camera, poses = camera_at(), motions(tilt=0.0)
    pixels = seen(camera, poses)
    found = hand_eye(camera, poses, pixels, point=(0.0, 0.0, POINT[2]))
    np.testing.assert_allclose(np.abs(found.fixed), [0, 0, 1], atol=1e-6)
    assert pose_errors(camera, found.camera.world_from_cam)[1] < 5
    assert np.linalg.norm(found.point - POINT) < 0.003
    unknown = hand_eye(camera, poses, pixels)
    shift = unknown.camera.position - found.camera.position
    np.testing.assert_allclose(shift, [0, 0, POINT[2]], atol=1e-3)  # the gripper's z axis points down


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        (motions(6), "in 6 poses, expected 8"),
        (motions(20, spread=(0.01, 0.01, 0.0), tilt=0.0), "leave the camera's uncertain"),
    ],
)
def test_motions_that_say_too_little_are_refused(poses, message):
    with pytest.raises(CalibrationError, match=message):
        hand_eye(camera_at(), poses, seen(camera_at(), poses))


def test_images_of_another_time_are_refused():
    camera, poses = camera_at(), motions(20)
    with pytest.raises(CalibrationError, match="poses of the gripper agree"):
        hand_eye(camera, poses, np.roll(seen(camera, poses), 7, axis=0))


def test_the_camera_that_is_given_does_not_matter():
    camera, poses = camera_at(), motions()
    pixels = seen(camera, poses)
    first, second = (
        hand_eye(replace(camera, world_from_cam=camera_at(azimuth).world_from_cam), poses, pixels)
        for azimuth in (0.0, 3.0)
    )
    np.testing.assert_allclose(first.camera.world_from_cam, second.camera.world_from_cam, atol=1e-6)
