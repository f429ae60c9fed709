import numpy as np
import pytest

from symview_sim.motions import MAX_STEP, MAX_TURN, nearest_turn, step_towards


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
