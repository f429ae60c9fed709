import numpy as np
import pytest

from symview_sim.control import COARSE
from symview_sim.motions import motion_to, sweep, yaw_difference


@pytest.mark.parametrize(
    ("start", "goal", "period", "expected"),
    [(0.0, 0.3, np.pi, 0.3), (1.5, -1.5, np.pi, np.pi - 3.0), (0.0, 1.5, np.pi / 2, 1.5 - np.pi / 2)],
)
def test_yaw_difference_is_the_smallest_rotation(start, goal, period, expected):
    assert yaw_difference(start, goal, period) == pytest.approx(expected)


def test_a_reflection_changes_the_sign_of_a_yaw_difference():
    rng = np.random.default_rng(0)
    for start, goal in rng.uniform(-2, 2, (50, 2)):
        assert yaw_difference(-start, -goal, np.pi / 2) == pytest.approx(-yaw_difference(start, goal, np.pi / 2))


def test_a_motion_is_the_whole_way_to_the_goal():
    motion = motion_to(np.array([0.1, 0.0, 0.2]), np.array([0.3, -0.01, 0.2]), yaw_change=2.0)
    np.testing.assert_allclose(motion, [0.2, -0.01, 0.0, 2.0])


STEP = COARSE.step
START, END, HEIGHT = np.array([0.05, -0.02]), np.array([-0.03, 0.10]), 0.03


@pytest.mark.parametrize(
    ("position", "expected"),
    [((0.0, 0.0, 0.2), (0.05, -0.02, -0.07)), ((0.05, -0.02, 0.13), (0.0, 0.0, -0.1)), ((0.05, -0.02, 0.03), None)],
    ids=["approach", "descend", "sweep"],
)
def test_the_phase_of_a_sweep_depends_on_the_grippers_position(position, expected):
    yaw = np.arctan2(*(END - START)[::-1]) + np.pi / 2
    motion = sweep(np.array(position), yaw, START, END, HEIGHT, STEP)
    if expected is None:  # straight along the line, no faster than the limit
        along = (END - START) / np.linalg.norm(END - START)
        assert np.abs(motion[:2]).max() == pytest.approx(STEP)
        np.testing.assert_allclose(motion[:2] / np.linalg.norm(motion[:2]), along)
    else:
        np.testing.assert_allclose(motion[:3], expected, atol=1e-9)
    assert motion[3] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("reflection", [1, -1])
@pytest.mark.parametrize("quarter_turns", range(4))
def test_a_sweep_is_equivariant_to_rotations_and_reflections(quarter_turns, reflection):
    angle = quarter_turns * np.pi / 2
    matrix = np.rint([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ np.diag([1, reflection])
    rng = np.random.default_rng(0)
    for _ in range(30):
        start, end = rng.uniform(-0.2, 0.2, (2, 2))
        position, yaw = np.append(start + rng.normal(0, 0.03, 2), rng.choice([0.03, 0.13, 0.2])), rng.uniform(-1.5, 1.5)
        motion = sweep(position, yaw, start, end, HEIGHT, STEP)
        transformed = sweep(
            np.append(matrix @ position[:2], position[2]),
            reflection * yaw + angle,
            matrix @ start,
            matrix @ end,
            HEIGHT,
            STEP,
        )
        np.testing.assert_allclose(transformed[:2], matrix @ motion[:2], atol=1e-9)
        np.testing.assert_allclose(transformed[2:], [motion[2], reflection * motion[3]], atol=1e-9)
