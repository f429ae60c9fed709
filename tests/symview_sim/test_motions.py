import numpy as np
import pytest

from symview_sim.motions import MAX_STEP, MAX_TURN, nearest_turn, step_towards, sweep


@pytest.mark.parametrize(
    ("start", "goal", "period", "expected"),
    [(0.0, 0.3, np.pi, 0.3), (1.5, -1.5, np.pi, np.pi - 3.0), (0.0, 1.5, np.pi / 2, 1.5 - np.pi / 2)],
)
def test_nearest_turn_takes_the_short_way(start, goal, period, expected):
    assert nearest_turn(start, goal, period) == pytest.approx(expected)


def test_nearest_turn_changes_sign_in_a_mirror():
    rng = np.random.default_rng(0)
    for start, goal in rng.uniform(-2, 2, (50, 2)):
        assert nearest_turn(-start, -goal, np.pi / 2) == pytest.approx(-nearest_turn(start, goal, np.pi / 2))


def test_a_step_is_clamped_and_says_whether_it_arrives():
    motion, arrives = step_towards(np.zeros(3), np.array([0.2, -0.01, 0.0]), turn=2.0)
    np.testing.assert_allclose(motion, [MAX_STEP, -0.01, 0.0, MAX_TURN])
    assert not arrives
    motion, arrives = step_towards(np.zeros(3), np.array([0.02, -0.01, 0.0]), turn=0.1)
    np.testing.assert_allclose(motion, [0.02, -0.01, 0.0, 0.1])
    assert arrives


START, END, HEIGHT = np.array([0.05, -0.02]), np.array([-0.03, 0.10]), 0.03


@pytest.mark.parametrize(
    ("position", "expected"),
    [((0.0, 0.0, 0.2), (0.05, -0.02, -0.05)), ((0.05, -0.02, 0.13), (0.0, 0.0, -0.05)), ((0.05, -0.02, 0.03), None)],
    ids=["approach", "descend", "sweep"],
)
def test_what_a_sweep_does_follows_from_where_the_gripper_is(position, expected):
    yaw = np.arctan2(*(END - START)[::-1]) + np.pi / 2
    motion = sweep(np.array(position), yaw, START, END, HEIGHT)
    if expected is None:  # straight along the line, no faster than the limit
        along = (END - START) / np.linalg.norm(END - START)
        assert np.abs(motion[:2]).max() == pytest.approx(MAX_STEP)
        np.testing.assert_allclose(motion[:2] / np.linalg.norm(motion[:2]), along)
    else:
        np.testing.assert_allclose(motion[:3], expected, atol=1e-9)
    assert motion[3] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("mirror", [1, -1])
@pytest.mark.parametrize("quarter_turns", range(4))
def test_a_turned_or_mirrored_sweep_is_the_sweep_turned_or_mirrored(quarter_turns, mirror):
    angle = quarter_turns * np.pi / 2
    matrix = np.rint([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ np.diag([1, mirror])
    rng = np.random.default_rng(0)
    for _ in range(30):
        start, end = rng.uniform(-0.2, 0.2, (2, 2))
        position, yaw = np.append(start + rng.normal(0, 0.03, 2), rng.choice([0.03, 0.13, 0.2])), rng.uniform(-1.5, 1.5)
        motion = sweep(position, yaw, start, end, HEIGHT)
        moved = sweep(
            np.append(matrix @ position[:2], position[2]), mirror * yaw + angle, matrix @ start, matrix @ end, HEIGHT
        )
        np.testing.assert_allclose(moved[:2], matrix @ motion[:2], atol=1e-9)
        np.testing.assert_allclose(moved[2:], [motion[2], mirror * motion[3]], atol=1e-9)
