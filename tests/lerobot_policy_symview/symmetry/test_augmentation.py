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
def test_elements_of_d4_map_pixels_onto_pixels(element):
    group = make_group("D4")
    reflected = IMAGES.flip(-1) if group.reflects(element) else IMAGES
    transformed = transform_images(IMAGES, PlanarTransform.of_element(group, element, IMAGES.flatten(1)))
    torch.testing.assert_close(transformed, torch.rot90(reflected, element % 4, (-2, -1)))


def test_images_of_a_batch_have_transforms_of_their_own():
    transform = PlanarTransform(torch.tensor([0.0, math.pi], dtype=torch.float64), torch.tensor([True, False]))
    transformed = transform_images(IMAGES, transform)
    torch.testing.assert_close(transformed[0], IMAGES[0].flip(-1))
    torch.testing.assert_close(transformed[1], IMAGES[1].flip((-2, -1)))


def test_autocast_keeps_the_precision_of_image_transforms():
    images = torch.rand(2, 3, 76, 76, generator=torch.Generator().manual_seed(0))
    transform = PlanarTransform.of_element(make_group("D4"), 1, images.flatten(1))
    with torch.autocast("cpu", torch.bfloat16):
        transformed = transform_images(images, transform)
    torch.testing.assert_close(transformed, torch.rot90(images, 1, (-2, -1)), rtol=0, atol=1e-4)


@pytest.mark.parametrize("element", range(8))
def test_oblong_images_are_cropped_to_their_central_square(element):
    group, oblong = make_group("D4"), torch.nn.functional.pad(IMAGES, (5, 3))
    transformed = transform_images(oblong, PlanarTransform.of_element(group, element, IMAGES.flatten(1)))
    torch.testing.assert_close(
        transformed, transform_images(oblong[..., 4:16], PlanarTransform.of_element(group, element, IMAGES))
    )


@pytest.mark.parametrize("reflected", [False, True])
@pytest.mark.parametrize("angle", [0.3, 1.9, 4.0])
def test_transformed_image_shows_the_transformed_gripper(angle, reflected):
    """The gripper image can be drawn at any angle: a reference for the transform of images."""
    state = torch.tensor([[0.06, -0.04, 0.2, 0.4, 1.0]], dtype=torch.float64)
    transform = PlanarTransform(torch.tensor([angle], dtype=torch.float64), torch.tensor([reflected]))
    transformed = VectorRepresentation(("x", "y", "z", "yaw", "aperture")).transform(
        state, transform, absolute_yaw=True
    )
    drawn = gripper_image(state, Workspace(), 128)[:, None]
    expected = gripper_image(transformed, Workspace(), 128)[:, None]
    assert (transform_images(drawn, transform) - expected).abs().mean() < 0.15 * expected.mean()


@pytest.mark.parametrize("augmentation", ["d4", "so2", "o2"])
def test_random_transforms_cover_exactly_the_chosen_set(augmentation):
    torch.manual_seed(0)
    transform = random_transform(*AUGMENTATIONS[augmentation], torch.zeros(400, 5))
    quarters = transform.angle / (math.pi / 2)
    assert transform.reflected.float().mean() == (0.0 if augmentation == "so2" else pytest.approx(0.5, abs=0.1))
    if augmentation == "d4":
        assert set(quarters.tolist()) == {0.0, 1.0, 2.0, 3.0}
    else:
        assert torch.histc(quarters, 8, 0, 4).min() > 25


@pytest.mark.parametrize("group", ["C4", "D4", "C8", "D8"])
def test_group_augmentation_draws_every_element(group):
    torch.manual_seed(0)
    transform = make_policy(group=group, augmentation="group").random_transform(torch.zeros(400, 5))
    elements = set(zip((transform.angle / (math.pi / 4)).round().tolist(), transform.reflected.tolist(), strict=True))
    expected = make_group(group)
    angles = {round(expected.angle(element) / (math.pi / 4)) for element in range(expected.size)}
    assert elements == {(angle, flip) for angle in angles for flip in ({False, True} if group[0] == "D" else {False})}


def test_centre_crop_commutes_with_quarter_turns():
    rotated = crop(torch.rot90(IMAGES, 1, (-2, -1)), 8)
    torch.testing.assert_close(rotated, torch.rot90(crop(IMAGES, 8), 1, (-2, -1)))


def test_scale_down_averages_larger_images_and_keeps_smaller_ones():
    torch.testing.assert_close(scale_down(IMAGES, 6), IMAGES.unfold(2, 2, 2).unfold(3, 2, 2).mean((-2, -1)))
    assert scale_down(IMAGES, 12) is IMAGES
    assert scale_down(IMAGES[..., :9, :], 6).shape[-2:] == (6, 8)


@pytest.mark.parametrize("size", [5, 7, 11])
def test_scale_down_commutes_with_quarter_turns_and_reflections(size):
    transformed = torch.rot90(IMAGES, 1, (-2, -1)).flip(-1)
    torch.testing.assert_close(
        scale_down(transformed, size), torch.rot90(scale_down(IMAGES, size), 1, (-2, -1)).flip(-1)
    )


def test_crops_start_at_their_offsets():
    offset = torch.tensor([[0.0, 0.0], [0.999, 0.5]])  # 8 possible rows and columns
    crops = crop(IMAGES, 5, offset)
    torch.testing.assert_close(crops[0], IMAGES[0, :, :5, :5])
    torch.testing.assert_close(crops[1], IMAGES[1, :, 7:, 4:9])


def test_every_crop_offset_is_equally_likely():
    torch.manual_seed(0)
    images = torch.arange(144.0).view(1, 1, 12, 12).expand(900, -1, -1, -1)
    corners = crop(images, 10, torch.rand(900, 2))[:, 0, 0, 0]
    counts = corners.unique(return_counts=True)[1]
    assert len(counts) == 9
    assert counts.min() > 70
