"""Cameras from which the arm hides the workspace are not placed."""

import numpy as np
import pytest

from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.placement import CameraSpec, CameraSpread
from symview_sim.settings import EnvSettings
from symview_sim.sight import LEAST_SEEN, seen_fraction


def make_env(robot="panda", **camera):
    return EnvSettings("block_picking", robot=robot, camera=CameraSpec(**camera)).make()


@pytest.fixture(scope="module")
def reset_env():
    env = make_env()
    env.reset(seed=0)
    yield env
    env.close()


@pytest.mark.parametrize(
    ("elevation", "azimuth", "low", "high"),
    [(45, 0, 0.98, 1), (45, 150, 0.98, 1), (45, 180, 0, 0.05), (75, 0, 0.7, 0.9)],
)
def test_the_seen_fraction_counts_what_the_arm_hides(reset_env, elevation, azimuth, low, high):
    camera = CameraSpec(elevation_deg=elevation, azimuth_deg=azimuth).place(reset_env.workspace)
    assert low <= seen_fraction(reset_env.scene.client, camera, reset_env.workspace) <= high


def test_the_seen_fraction_does_not_depend_on_the_images_size(reset_env):
    fractions = [
        seen_fraction(
            reset_env.scene.client,
            CameraSpec(elevation_deg=75, height=height, width=width).place(reset_env.workspace),
            reset_env.workspace,
        )
        for height, width in ((152, 152), (480, 640), (40, 40))
    ]
    assert max(fractions) - min(fractions) < 0.03


def test_a_camera_behind_the_arm_is_refused():
    env = make_env(azimuth_deg=180.0)
    with pytest.raises(
        CalibrationError, match=r"camera 'side': the arm hides \d+% of the workspace.*azimuth_deg \(got 180"
    ):
        env.reset(seed=0)
    env.close()


def test_a_camera_that_does_not_see_the_arm_is_not_refused():
    env = make_env(azimuth_deg=180.0, sees_robot=False)
    env.reset(seed=0)
    env.close()


def test_spread_cameras_are_drawn_where_they_see_past_the_arm():
    env = make_env(azimuth_deg=180.0, spread=CameraSpread(azimuth_deg=60.0))
    azimuths = []
    for seed in range(12):
        env.reset(seed=seed)
        assert seen_fraction(env.scene.client, env.cameras["side"], env.workspace) >= LEAST_SEEN
        x, y = env.cameras["side"].position[:2] - env.workspace.center
        azimuths.append(np.rad2deg(np.arctan2(y, x)))
    assert min(np.abs(azimuths)) < 150  # both sides of the arm, and nothing behind it
    assert max(np.abs(azimuths)) < 178
    env.close()
