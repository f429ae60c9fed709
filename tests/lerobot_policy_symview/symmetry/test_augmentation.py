import math

import pytest
import torch

from lerobot_policy_symview.symmetry.augmentation import (
    AUGMENTATIONS,
    crop,
    random_transform,
    scale_down,
    transform_images,
)
from lerobot_policy_symview.symmetry.groups import make_group
from lerobot_policy_symview.symmetry.representations import VectorRepresentation
from lerobot_policy_symview.symmetry.transforms import PlanarTransform
from lerobot_symview.geometry.gripper import gripper_image
from lerobot_symview.geometry.workspace import Workspace
from tests.helpers.policies import make_policy

IMAGES = torch.rand(2, 3, 12, 12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize("element", range(8))
def test_elements_of_d4_move_pixels_onto_pixels(element):
    group = make_group("D4")
    flipped = IMAGES.flip(-1) if group.reflects(element) else IMAGES
    moved = transform_images(IMAGES, PlanarTransform.of_element(group, element, IMAGES.flatten(1)))
    torch.testing.assert_close(moved, torch.rot90(flipped, element % 4, (-2, -1)))


def test_images_of_a_batch_move_by_their_own_motions():
    motion = PlanarTransform(torch.tensor([0.0, math.pi], dtype=torch.float64), torch.tensor([True, False]))
    moved = transform_images(IMAGES, motion)
    torch.testing.assert_close(moved[0], IMAGES[0].flip(-1))
    torch.testing.assert_close(moved[1], IMAGES[1].flip((-2, -1)))


def test_autocast_does_not_lower_the_precision_of_motions():
    images = torch.rand(2, 3, 76, 76, generator=torch.Generator().manual_seed(0))
    motion = PlanarTransform.of_element(make_group("D4"), 1, images.flatten(1))
    with torch.autocast("cpu", torch.bfloat16):
        moved = transform_images(images, motion)
    torch.testing.assert_close(moved, torch.rot90(images, 1, (-2, -1)), rtol=0, atol=1e-4)


@pytest.mark.parametrize("element", range(8))
def test_of_oblong_images_the_middle_square_moves(element):
    group, oblong = make_group("D4"), torch.nn.functional.pad(IMAGES, (5, 3))
    moved = transform_images(oblong, PlanarTransform.of_element(group, element, IMAGES.flatten(1)))
    torch.testing.assert_close(
        moved, transform_images(oblong[..., 4:16], PlanarTransform.of_element(group, element, IMAGES))
    )


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("angle", [0.3, 1.9, 4.0])
def test_a_moved_picture_shows_the_moved_gripper(angle, mirrored):
    """The drawn gripper is known at any angle: what the image's motion has to agree with."""
    state = torch.tensor([[0.06, -0.04, 0.2, 0.4, 1.0]], dtype=torch.float64)
    motion = PlanarTransform(torch.tensor([angle], dtype=torch.float64), torch.tensor([mirrored]))
    moved = VectorRepresentation(("x", "y", "z", "yaw", "aperture")).transform(state, motion, absolute_yaw=True)
    drawn = gripper_image(state, Workspace(), 128)[:, None]
    expected = gripper_image(moved, Workspace(), 128)[:, None]
    assert (transform_images(drawn, motion) - expected).abs().mean() < 0.15 * expected.mean()


@pytest.mark.parametrize("augmentation", ["d4", "so2", "o2"])
def test_random_motions_reach_all_they_may_and_nothing_else(augmentation):
    torch.manual_seed(0)
    motion = random_transform(*AUGMENTATIONS[augmentation], torch.zeros(400, 5))
    quarters = motion.angle / (math.pi / 2)
    assert motion.reflected.float().mean() == (0.0 if augmentation == "so2" else pytest.approx(0.5, abs=0.1))
    if augmentation == "d4":
        assert set(quarters.tolist()) == {0.0, 1.0, 2.0, 3.0}
    else:
        assert torch.histc(quarters, 8, 0, 4).min() > 25


@pytest.mark.parametrize("group", ["C4", "D4", "C8", "D8"])
def test_augmentation_by_the_group_draws_all_its_elements(group):
    torch.manual_seed(0)
    motion = make_policy(group=group, augmentation="group").random_transform(torch.zeros(400, 5))
    elements = set(zip((motion.angle / (math.pi / 4)).round().tolist(), motion.reflected.tolist(), strict=True))
    expected = make_group(group)
    angles = {round(expected.angle(element) / (math.pi / 4)) for element in range(expected.size)}
    assert elements == {(angle, flip) for angle in angles for flip in ({False, True} if group[0] == "D" else {False})}


def test_the_middle_commutes_with_quarter_turns():
    turned = crop(torch.rot90(IMAGES, 1, (-2, -1)), 8)
    torch.testing.assert_close(turned, torch.rot90(crop(IMAGES, 8), 1, (-2, -1)))


def test_larger_images_are_averaged_and_smaller_ones_stay():
    torch.testing.assert_close(scale_down(IMAGES, 6), IMAGES.unfold(2, 2, 2).unfold(3, 2, 2).mean((-2, -1)))
    assert scale_down(IMAGES, 12) is IMAGES
    assert scale_down(IMAGES[..., :9, :], 6).shape[-2:] == (6, 8)


@pytest.mark.parametrize("size", [5, 7, 11])
def test_scaling_commutes_with_quarter_turns_and_mirror_images(size):
    moved = torch.rot90(IMAGES, 1, (-2, -1)).flip(-1)
    torch.testing.assert_close(scale_down(moved, size), torch.rot90(scale_down(IMAGES, size), 1, (-2, -1)).flip(-1))


def test_parts_begin_where_they_are_placed():
    offset = torch.tensor([[0.0, 0.0], [0.999, 0.5]])  # 8 possible rows and columns
    parts = crop(IMAGES, 5, offset)
    torch.testing.assert_close(parts[0], IMAGES[0, :, :5, :5])
    torch.testing.assert_close(parts[1], IMAGES[1, :, 7:, 4:9])


def test_every_place_is_as_likely():
    torch.manual_seed(0)
    images = torch.arange(144.0).view(1, 1, 12, 12).expand(900, -1, -1, -1)
    corners = crop(images, 10, torch.rand(900, 2))[:, 0, 0, 0]
    counts = corners.unique(return_counts=True)[1]
    assert len(counts) == 9
    assert counts.min() > 70
