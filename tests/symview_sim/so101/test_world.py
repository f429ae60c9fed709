"""The simulated SO-101: its motors, its camera against the known cube, and the expert."""

import numpy as np
import pytest
import yaml

from lerobot_symview.calibration.file import parse_calibration
from lerobot_symview.geometry.camera import invert_rigid, project, transform, unproject
from symview_sim.so101.expert import So101Expert
from symview_sim.so101.world import CAMERA, HALF_CUBE, OPEN, WORKSPACE, WORLD_FROM_BASE, So101World
from tests.helpers.arms import so101
from tests.helpers.so101 import CAMERAS

AWAY = np.array([-100.0, -46.0, 26.0, 74.0, 0.0, OPEN])


@pytest.fixture(scope="module")
def world():
    world = So101World()
    yield world
    world.close()


def test_the_scene_follows_from_the_seed(world):
    found = []
    for seed in (3, 4, 3):
        world.reset(seed)
        found.append(np.concatenate([world.joints(), world.cube()[0]]))
    np.testing.assert_array_equal(found[0], found[2])
    assert np.abs(found[0] - found[1]).max() > 1


def test_motors_bring_the_joints_to_their_targets_but_for_the_arms_weight(world):
    world.reset(0)
    targets = np.array([40.0, -20.0, 10.0, 60.0, -30.0, 20.0])
    for _ in range(20):
        world.move(targets)
    np.testing.assert_allclose(world.joints() + world.droop(), targets, atol=0.5)
    assert np.abs(world.droop()).max() > 1


@pytest.mark.parametrize("seed", range(4))
def test_the_camera_sees_the_cube_where_it_is(world, seed):
    world.reset(seed)
    for _ in range(20):
        world.move(AWAY)  # the arm is beside the camera's view of the cube
    images = world.images()
    center, yaw = world.cube()
    red, green, blue = images.rgb.astype(int).transpose(2, 0, 1)
    is_cube = (red > green + 25) & (blue > green + 25)
    pixels = np.argwhere(is_cube)[:, ::-1]
    corners = HALF_CUBE * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    projected, _ = project(transform(WORLD_FROM_BASE, corners @ turn.T + center), CAMERA)
    np.testing.assert_allclose(pixels.min(axis=0), projected.min(axis=0), atol=1.5)
    np.testing.assert_allclose(pixels.max(axis=0), projected.max(axis=0), atol=1.5)
    seen = transform(invert_rigid(WORLD_FROM_BASE), unproject(images.depth, CAMERA)[is_cube])
    inside = np.abs((seen - center) @ turn).max(axis=1)
    assert np.abs(inside - HALF_CUBE).max() < 0.001  # on the cube's surface


def test_the_calibration_of_the_page_has_the_camera_the_base_and_the_workspace():
    calibration = parse_calibration(yaml.safe_load(CAMERAS))  # in the axes of the base
    camera = calibration.camera("side")
    np.testing.assert_allclose(camera.intrinsics, CAMERA.intrinsics, atol=1e-4)
    np.testing.assert_allclose(camera.world_from_cam, invert_rigid(WORLD_FROM_BASE) @ CAMERA.world_from_cam, atol=1e-5)
    assert (camera.height, camera.width) == (CAMERA.height, CAMERA.width)
    center = transform(invert_rigid(WORLD_FROM_BASE), np.array([*WORKSPACE.center, 0.0]))
    np.testing.assert_allclose(calibration.workspace.center, center[:2], atol=1e-9)
    assert (calibration.workspace.size, calibration.workspace.height_limit) == (WORKSPACE.size, WORKSPACE.height_limit)


@pytest.mark.parametrize("seed", range(3))
def test_the_expert_lifts_the_cube(world, seed):
    world.reset(seed)
    expert = So101Expert(world, so101())
    assert not world.is_lifted()
    steps = 0
    while not world.is_lifted() and steps < 40:
        world.move(expert.action())
        steps += 1
    assert world.is_lifted()
    joints = world.joints()
    for _ in range(5):
        world.move(np.append(joints[:5], OPEN))
    assert not world.is_gripped()
    assert not world.is_lifted()
