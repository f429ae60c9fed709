import numpy as np
import pytest

from lerobot_symview.errors import CalibrationError, OptionError
from lerobot_symview.geometry.camera import project
from lerobot_symview.geometry.placement import CameraSpec, CameraSpread, top_camera

SPREAD = CameraSpread(elevation_deg=20.0, azimuth_deg=180.0, distance=0.1, target=0.03)


@pytest.mark.parametrize("elevation", [15, 30, 45, 60, 75])
def test_the_default_camera_shows_the_whole_working_volume(workspace, elevation):
    camera = CameraSpec(elevation_deg=elevation).place(workspace)
    assert workspace.visible_fraction(camera) == 1.0


def test_a_camera_that_misses_the_workspace_is_rejected_with_the_visible_fraction(workspace):
    with pytest.raises(ValueError, match=r"sees \d+% of the workspace"):
        CameraSpec(fov_deg=8.0).place(workspace)


@pytest.mark.parametrize(
    "fields",
    [
        {"elevation_deg": 0.0},
        {"elevation_deg": 91.0},
        {"height": 2},
        {"name": "my camera"},
        {"intrinsics": (1.0, 2.0)},
        {"world_from_cam": (1.0, 2.0)},
        {"depth_noise": -1.0},
        {"depth_dropout": 2.0},
    ],
    ids=lambda f: str(f),
)
def test_invalid_placements_are_rejected(fields):
    with pytest.raises(OptionError, match=next(iter(fields))):
        CameraSpec(**fields)


def test_a_negative_spread_is_rejected():
    with pytest.raises(OptionError, match="negative"):
        CameraSpread(distance=-0.1)


def test_a_spread_as_large_as_the_distance_is_rejected():
    with pytest.raises(OptionError, match=r"spread\.distance must be smaller than distance"):
        CameraSpec(spread=CameraSpread(distance=0.9))


def test_elevations_are_sampled_uniformly_up_to_90_degrees(workspace):
    spec = CameraSpec(elevation_deg=80.0, spread=CameraSpread(elevation_deg=30.0))
    rng = np.random.default_rng(0)
    poses = [spec.place(workspace, rng).position - [*workspace.center, 0.0] for _ in range(200)]
    elevations = np.rad2deg(np.arcsin([pose[2] / np.linalg.norm(pose) for pose in poses]))
    assert (np.histogram(elevations, bins=4, range=(50.0, 90.0))[0] > 30).all()
    assert len(set(elevations)) == 200


def test_a_spread_with_a_pose_matrix_is_rejected():
    with pytest.raises(OptionError, match="spread needs a pose by angles"):
        CameraSpec(world_from_cam=tuple(np.eye(4).ravel()), spread=SPREAD)


def test_matrices_and_angles_give_the_same_camera(workspace):
    by_angles = CameraSpec(elevation_deg=30.0, azimuth_deg=40.0, target=(0.02, -0.01, 0.03)).place(workspace)
    matrices = {
        "intrinsics": tuple(by_angles.intrinsics.ravel()),
        "world_from_cam": tuple(by_angles.world_from_cam.ravel()),
    }
    by_matrices = CameraSpec(**matrices).place(workspace)
    np.testing.assert_array_equal(by_matrices.intrinsics, by_angles.intrinsics)
    np.testing.assert_array_equal(by_matrices.world_from_cam, by_angles.world_from_cam)


def test_an_invalid_pose_matrix_is_rejected(workspace):
    with pytest.raises(CalibrationError, match="reflection"):
        CameraSpec(world_from_cam=tuple(np.diag([-1.0, 1.0, 1.0, 1.0]).ravel())).place(workspace)


def test_the_camera_looks_at_its_target(workspace):
    spec = CameraSpec(height=100, width=140, target=(0.05, -0.04, 0.1))
    pixel, depth = project(np.array([*workspace.center, 0.0]) + spec.target, spec.place(workspace))
    np.testing.assert_allclose(pixel, [69.5, 49.5], atol=1e-9)
    assert depth == pytest.approx(spec.distance)


def test_sampled_poses_are_within_the_spread_and_show_the_workspace(workspace):
    spec = CameraSpec(elevation_deg=50.0, distance=0.9, spread=SPREAD)
    rng = np.random.default_rng(0)
    cameras = [spec.place(workspace, rng) for _ in range(200)]
    target = np.array([*workspace.center, 0.0])
    offsets = np.array([camera.position - target for camera in cameras])
    distances = np.linalg.norm(offsets, axis=1)
    elevations = np.rad2deg(np.arcsin(offsets[:, 2] / distances))
    slack = 0.03 * np.sqrt(3)
    assert (np.abs(distances - 0.9) <= 0.1 + slack).all()
    assert elevations.min() > 25.0
    assert elevations.max() < 75.0
    assert np.ptp(elevations) > 30.0
    azimuths = np.arctan2(offsets[:, 1], offsets[:, 0])
    assert (np.histogram(azimuths, bins=4, range=(-np.pi, np.pi))[0] > 30).all()
    assert min(workspace.visible_fraction(camera) for camera in cameras) >= 0.6


def test_a_spread_without_a_pose_that_shows_the_workspace_is_rejected(workspace):
    spec = CameraSpec(fov_deg=8.0, spread=SPREAD)
    with pytest.raises(ValueError, match="of the workspace"):
        spec.place(workspace, np.random.default_rng(0))


def test_without_a_spread_the_pose_is_the_nominal_one(workspace):
    np.testing.assert_array_equal(
        CameraSpec().place(workspace, np.random.default_rng(0)).world_from_cam,
        CameraSpec().place(workspace).world_from_cam,
    )


def test_the_oracle_camera_shows_exactly_the_workspace(workspace):
    camera = top_camera(100, workspace).place(workspace)
    pixels, _ = project(workspace.corners(), camera)
    np.testing.assert_allclose(pixels, [[-0.5, -0.5], [99.5, -0.5], [99.5, 99.5], [-0.5, 99.5]], atol=1e-6)
