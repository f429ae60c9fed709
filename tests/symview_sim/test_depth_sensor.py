import numpy as np
import pytest

from symview_sim.depth_sensor import degrade


@pytest.mark.parametrize("metres", [0.5, 1.0, 2.0])
def test_noise_grows_with_the_square_of_the_depth(metres):
    depth = np.full((200, 200), metres, dtype=np.float32)
    measured = degrade(depth, noise=0.002, dropout=0.0, rng=np.random.default_rng(0))
    assert measured.dtype == np.float32
    assert measured.std() == pytest.approx(0.002 * metres**2, rel=0.02)
    assert measured.mean() == pytest.approx(metres, abs=1e-4)


def test_dropout_is_ten_times_as_frequent_beside_a_discontinuity():
    depth = np.full((300, 300), 1.0, dtype=np.float32)
    depth[:, 150:] = 0.9
    lost = degrade(depth, noise=0.0, dropout=0.03, rng=np.random.default_rng(0)) == 0
    beside = np.zeros_like(lost)
    beside[:, 149:151] = True
    assert lost[~beside].mean() == pytest.approx(0.03, abs=0.003)
    assert lost[beside].mean() == pytest.approx(0.3, abs=0.06)
    kept = ~lost
    np.testing.assert_array_equal(
        degrade(depth, noise=0.0, dropout=0.03, rng=np.random.default_rng(0))[kept], depth[kept]
    )


def test_invalid_depth_stays_invalid():
    depth = np.zeros((20, 20), dtype=np.float32)
    assert not degrade(depth, noise=0.1, dropout=0.1, rng=np.random.default_rng(0)).any()


def test_flying_pixels_lie_between_the_surfaces_at_a_discontinuity():
    depth = np.full((300, 300), 1.0, dtype=np.float32)
    depth[:, 150:] = 0.9
    depth[:10] = 0
    measured = degrade(depth, noise=0.0, dropout=0.0, rng=np.random.default_rng(0), flying=0.5)
    changed = measured != depth
    assert not changed[:, :149].any()
    assert not changed[:, 151:].any()
    assert not changed[:11].any()  # nothing flies before the horizon
    assert changed[11:, 149:151].mean() == pytest.approx(0.5, abs=0.06)
    assert ((measured[changed] > 0.9) & (measured[changed] < 1.0)).all()
