import math

import pytest
import torch

from lerobot_policy_symview.augmentation import center_crop, random_crop, turn_images

IMAGES = torch.rand(2, 3, 12, 12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
def test_a_quarter_turn_is_rot90(quarter_turns):
    angle = torch.full((2,), quarter_turns * math.pi / 2, dtype=torch.float64)
    torch.testing.assert_close(turn_images(IMAGES, angle), torch.rot90(IMAGES, quarter_turns, (-2, -1)))


def test_images_of_a_batch_turn_by_their_own_angles():
    angle = torch.tensor([0.0, math.pi], dtype=torch.float64)
    turned = turn_images(IMAGES, angle)
    torch.testing.assert_close(turned[0], IMAGES[0])
    torch.testing.assert_close(turned[1], IMAGES[1].flip((-2, -1)))


def test_the_centre_crop_commutes_with_quarter_turns():
    turned = center_crop(torch.rot90(IMAGES, 1, (-2, -1)), 8)
    torch.testing.assert_close(turned, torch.rot90(center_crop(IMAGES, 8), 1, (-2, -1)))


def test_random_crops_are_windows_of_their_images():
    torch.manual_seed(0)
    for crop in (random_crop(IMAGES, 5) for _ in range(10)):
        assert crop.shape == (2, 3, 5, 5)
        for image, window in zip(IMAGES, crop, strict=True):
            windows = image.unfold(1, 5, 1).unfold(2, 5, 1)
            assert (windows == window[:, None, None]).all(dim=(0, 3, 4)).any()


def test_random_crops_reach_every_place():
    torch.manual_seed(0)
    corners = {float(random_crop(IMAGES[:1], 11)[0, 0, 0, 0]) for _ in range(60)}
    assert len(corners) == 4
