"""Errors of a stated calibration."""

import numpy as np
import pytest

from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.miscalibration import Miscalibration
from tests.helpers.cameras import make_camera


@pytest.mark.parametrize("errors", [(0.01, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 0.05), (0.03, 5.0, 0.01)])
def test_the_stated_camera_differs_by_the_given_errors(errors):
    camera = make_camera(40, 30)
    miscalibration = Miscalibration(*errors)
    stated = [miscalibration.stated(camera, np.random.default_rng(seed)) for seed in range(20)]
    for other in stated:
        assert np.linalg.norm(other.position - camera.position) == pytest.approx(errors[0], abs=1e-9)
        turned = other.world_from_cam[:3, :3] @ camera.world_from_cam[:3, :3].T
        angle = np.degrees(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)))
        assert angle == pytest.approx(errors[1], abs=1e-5)
        assert abs(other.fx / camera.fx - 1) == pytest.approx(errors[2], abs=1e-9)
        assert (other.cx, other.cy, other.height) == (camera.cx, camera.cy, camera.height)
    if errors[0]:
        assert np.linalg.norm(np.mean([other.position - camera.position for other in stated], axis=0)) < errors[0] / 2
    if errors[2]:
        assert {np.sign(other.fx - camera.fx) for other in stated} == {-1.0, 1.0}


def test_no_error_is_false_and_changes_nothing():
    camera = make_camera()
    stated = Miscalibration().stated(camera, np.random.default_rng(0))
    assert not Miscalibration()
    assert Miscalibration(focal=0.01)
    np.testing.assert_array_equal(stated.world_from_cam, camera.world_from_cam)
    np.testing.assert_array_equal(stated.intrinsics, camera.intrinsics)


@pytest.mark.parametrize("errors", [{"position": -0.01}, {"rotation_deg": 200.0}, {"focal": 1.0}, {"focal": np.nan}])
def test_impossible_errors_are_refused(errors):
    with pytest.raises(OptionError, match=next(iter(errors))):
        Miscalibration(**errors)
