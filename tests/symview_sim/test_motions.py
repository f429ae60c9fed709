import numpy as np
import pytest

from symview_sim.motions import EXPERT_TURN, MAX_STEP, is_there, nearest_turn, step_towards


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


def test_a_step_is_clamped():
    motion = step_towards(np.zeros(3), np.array([0.2, -0.01, 0.0]), turn=2.0)
    np.testing.assert_allclose(motion, [MAX_STEP, -0.01, 0.0, EXPERT_TURN])


@pytest.mark.parametrize(
    ("offset", "turn", "there"), [((0.009, 0, 0), 0.05, True), ((0, 0, 0.02), 0.0, False), ((0, 0, 0), -0.2, False)]
)
def test_a_goal_is_reached_in_position_and_yaw(offset, turn, there):
    assert is_there(np.zeros(3), np.array(offset), turn) is there
