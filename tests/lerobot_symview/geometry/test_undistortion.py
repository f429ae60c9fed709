"""Images without the distortion of their lens."""

from dataclasses import replace

import numpy as np
import pytest

from lerobot_symview.calibration.board import Board
from lerobot_symview.geometry.camera import from_ideal
from lerobot_symview.geometry.lens import EQUIDISTANT, PLUMB_BOB, Lens
from lerobot_symview.geometry.undistortion import undistorted
from tests.helpers.boards import camera_over, photograph

CAMERA = camera_over(Board(), 50, 30, 0.6)
BARREL = (-0.2, 0.08, 0.001, -0.0005)


def test_the_image_is_that_of_a_pinhole_camera():
    seen, expected = (photograph(Board(), CAMERA, lens, noise=0).astype(int) for lens in (BARREL, ()))
    shown = undistorted(seen.astype(np.uint8), replace(CAMERA, lens=Lens(PLUMB_BOB, BARREL))).astype(int)
    inner = np.s_[20:-20, 20:-20]
    remaining, removed = (np.abs(image - expected)[inner].mean() for image in (shown, seen))
    assert remaining < 0.4 * removed  # grey levels: edges that were interpolated twice


@pytest.mark.parametrize(
    "lens", [Lens(EQUIDISTANT, (0.05, -0.01, 0.002, 0.0)), Lens(PLUMB_BOB, (0.1, -0.02, 0.0, 0.0))]
)
def test_a_gradient_tells_from_which_pixel_each_value_is(lens):
    """Without a channel; where the lens shows nothing, the image is black."""
    camera = replace(CAMERA, lens=lens)
    columns = np.broadcast_to(100 + np.arange(640) // 8, (480, 640)).astype(np.uint8)
    shown = undistorted(columns, camera)
    v, u = np.meshgrid(np.arange(5, 475, 30.0), np.arange(5, 635, 30.0), indexing="ij")
    pixels = from_ideal(np.stack([u, v], axis=-1), camera)
    inside = ((pixels > 1) & (pixels < [638, 478])).all(axis=-1)
    values = shown[v.astype(int), u.astype(int)]
    np.testing.assert_allclose(values[inside], (100 + pixels[..., 0] // 8)[inside], atol=1)
    outside = ((pixels < -1) | (pixels > [640, 480])).any(axis=-1)
    assert outside.any() == (lens.model == PLUMB_BOB)
    assert (values[outside] == 0).all()


def test_an_image_without_a_lens_is_returned():
    image = np.zeros((480, 640, 3), np.uint8)
    assert undistorted(image, CAMERA) is image
