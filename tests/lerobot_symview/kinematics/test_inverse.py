"""Inverse kinematics: to 0.1 mm and 0.1 degrees where the pose is in reach, within limits, and honest elsewhere."""

import numpy as np
import pytest

from lerobot_symview.kinematics import solve
from lerobot_symview.kinematics.pose import differences, is_singular, tool_poses
from tests.helpers.arms import bullet_places, mujoco_places, panda, random_positions, so101


def reachable(model, count):
    """Joint positions whose pose is not singular, and the pose."""
    positions = random_positions(model, count)
    frames = model.forward(positions)
    kept = ~is_singular(frames, model.pivot)
    return positions[kept], tool_poses(frames[kept], model.pivot)


@pytest.mark.parametrize(("make", "places_of"), [(so101, mujoco_places), (panda, bullet_places)])
def test_solutions_are_at_their_targets_in_the_simulator(make, places_of):
    model = make()
    positions, targets = reachable(model, 200)
    starts = positions + np.random.default_rng(1).normal(0, 0.03, positions.shape)
    found = [solve(model, start, target) for start, target in zip(starts, targets, strict=True)]
    solved = np.array([solution.positions for solution in found])
    places, _ = places_of(solved)
    np.testing.assert_allclose(places, targets[:, :3], atol=1e-4)
    assert np.rad2deg(max(solution.angle for solution in found)) < 0.1
    assert max(solution.distance for solution in found) < 1e-4
    assert (solved >= model.lower).all()
    assert (solved <= model.upper).all()


def test_the_solution_of_the_present_pose_is_the_present_positions():
    positions, targets = reachable(so101(), 50)
    for start, target in zip(positions, targets, strict=True):
        np.testing.assert_allclose(solve(so101(), start, target).positions, start, atol=1e-5)


def test_out_of_reach_the_error_is_what_the_solution_leaves():
    model = so101()
    start = np.zeros(5)
    target = tool_poses(model.forward(start[None]), model.pivot)[0]
    target[0] += 1.0
    found = solve(model, start, target)
    there = tool_poses(model.forward(found.positions[None]), model.pivot)[0]
    assert found.distance == pytest.approx(np.linalg.norm(differences(there, target)[:3]))
    assert found.distance > 0.5
    assert (found.positions >= model.lower).all()
    assert (found.positions <= model.upper).all()


def test_a_start_outside_the_limits_is_brought_within_them():
    model = so101()
    _, targets = reachable(model, 5)
    found = solve(model, model.upper + 1, targets[0])
    assert (found.positions <= model.upper).all()


def test_tilt_passes_the_vertical_and_yaw_is_that_of_the_fingers():
    frame = np.eye(4)
    frame[:3, :3] = np.diag([1.0, -1.0, -1.0])  # fingers down, opening along x
    frame[:3, 3] = [0.3, 0.0, 0.1]
    turned = np.stack([frame, frame, frame])
    for index, angle in enumerate((-0.2, 0.0, 0.2)):  # about -y the fingers swing outwards
        c, s = np.cos(angle), np.sin(angle)
        turned[index, :3, :3] = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ frame[:3, :3]
    poses = tool_poses(turned, np.zeros(2))
    np.testing.assert_allclose(poses[:, 4], [-0.2, 0.0, 0.2], atol=1e-12)
    np.testing.assert_allclose(poses[:, [3, 5]], 0.0, atol=1e-12)
    turn = np.eye(4)
    turn[:2, :2] = [[0, -1], [1, 0]]
    quarter = tool_poses(turn @ turned, np.zeros(2))  # the whole scene turned about the base
    np.testing.assert_allclose(quarter[:, 4:], poses[:, 4:], atol=1e-12)
    np.testing.assert_allclose(np.abs(quarter[:, 3]), np.pi / 2, atol=1e-12)


def test_singular_poses_are_told():
    down = np.eye(4)
    down[:3, :3], down[:3, 3] = np.diag([1.0, -1.0, -1.0]), [0.3, 0.0, 0.1]
    over = down.copy()
    over[:3, 3] = 0.0
    up, level = down.copy(), down.copy()
    up[:3, :3] = np.eye(3)
    level[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # the rest of an arm: fingers ahead, opening up and down
    assert is_singular(np.stack([down, over, up, level]), np.zeros(2)).tolist() == [False, True, True, False]
