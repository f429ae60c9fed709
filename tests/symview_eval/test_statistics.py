import pytest

from symview_eval.statistics import SuccessRate


def test_wilson_interval_known_answer():
    low, high = SuccessRate(45, 50).interval
    assert low == pytest.approx(0.7864, abs=1e-3)
    assert high == pytest.approx(0.9565, abs=1e-3)


def test_wilson_interval_at_zero_and_one():
    assert SuccessRate(10, 10).interval[1] == 1.0
    assert SuccessRate(0, 10).interval[0] == 0.0


@pytest.mark.parametrize(("successes", "episodes"), [(3, 2), (-1, 2), (0, 0)])
def test_invalid_counts_are_refused(successes, episodes):
    with pytest.raises(ValueError, match="not a rate"):
        SuccessRate(successes, episodes)
