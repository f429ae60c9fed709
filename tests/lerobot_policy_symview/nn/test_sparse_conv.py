"""Convolutions that are computed near occupied voxels, against whole ones."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from lerobot_policy_symview.nn.encoders.convolutional import ConvolutionalEncoder
from lerobot_policy_symview.nn.encoders.voxel import VoxelEncoder
from lerobot_policy_symview.nn.sparse_conv import SparseGrid, conv_and_pool
from lerobot_policy_symview.symmetry.groups import make_group

SIZES = (8, 16, 12)


def occupied(kind):
    mask = torch.zeros(2, 1, *SIZES, dtype=torch.bool)
    if kind == "corners":
        for z, x, y in ([0, 0, 0], [7, 15, 0], [0, 15, 11], [7, 0, 11]):
            mask[0, 0, z, x, y] = True
    elif kind == "table and blocks":
        mask[:, :, 0] = True
        mask[0, :, :4, 3:6, 5:7] = mask[1, :, 3:4, 0:2, 10:] = True
    elif kind == "full":
        mask[:] = True
    return mask.double()


@pytest.mark.parametrize("kind", ["empty", "corners", "table and blocks", "full"])
def test_sparse_convolutions_equal_whole_ones(kind):
    """Two layers and their gradients, with biases and a channel that empty voxels have too."""
    generator = torch.Generator().manual_seed(0)
    shapes = [(5, 3, 3, 3, 3), (5,), (4, 5, 3, 3, 3), (4,)]
    parameters = [torch.randn(shape, generator=generator, dtype=torch.float64) for shape in shapes]
    mask = occupied(kind)
    state = torch.rand(2, 1, 1, 1, 1, generator=generator, dtype=torch.float64)
    values = torch.rand(2, 2, *SIZES, generator=generator, dtype=torch.float64) * mask
    grid = torch.cat([values, state.expand(-1, -1, *SIZES)], dim=1)
    empty = torch.cat([torch.zeros(2, 2, 12, 12, 12), state.expand(-1, -1, 12, 12, 12)], dim=1)

    def sparse(weight, bias, second_weight, second_bias):
        first = conv_and_pool(SparseGrid(grid.movedim(1, -1), mask, empty), weight, bias)
        return conv_and_pool(first, second_weight, second_bias).values.movedim(-1, 1)

    def whole(weight, bias, second_weight, second_bias):
        features = functional.relu(functional.max_pool3d(functional.conv3d(grid, weight, bias, padding=1), 2))
        second = functional.conv3d(features, second_weight, second_bias, padding=1)
        return functional.relu(functional.max_pool3d(second, 2))

    results = []
    for function in (sparse, whole):
        copies = [parameter.clone().requires_grad_() for parameter in parameters]
        features = function(*copies)
        results.append([features, *torch.autograd.grad(features.square().sum(), copies)])
    torch.testing.assert_close(*results)


def test_values_that_no_active_voxel_sees_are_ignored():
    """The grid there is taken from the empty one: the layer computes nothing far from active voxels."""
    weight, bias = torch.rand(2, 3, 3, 3, 3, generator=torch.Generator().manual_seed(0)), torch.rand(2)
    active = torch.zeros(1, 1, 8, 8, 8)
    active[..., 0, 0, 0] = 1
    result = conv_and_pool(SparseGrid(torch.ones(1, 8, 8, 8, 3), active, torch.zeros(1, 3, 6, 6, 6)), weight, bias)
    assert result.active.sum() == 1
    inside = result.values[0, 1:-1, 1:-1, 1:-1]
    torch.testing.assert_close(inside, bias.expand_as(inside))
    assert not torch.allclose(result.values[0, 0, 0, 0], bias)


def test_the_voxel_encoder_equals_its_whole_convolutions():
    torch.manual_seed(0)
    encoder = VoxelEncoder(make_group("D4"), 5, np.ones((8, 3, 3)), 16)
    for layer in encoder.layers:
        torch.nn.init.normal_(layer.bias)
    mask = torch.zeros(2, 1, 32, 64, 64, dtype=torch.bool)
    mask[:, :, 0] = mask[0, :, :9, 20:29, 31:40] = True
    gripper = torch.zeros(2, 1, 32, 64, 64)
    gripper[:, :, 20:24, 40:44, 7:11] = 1.0
    grid, state = torch.cat([mask, torch.rand(2, 3, 32, 64, 64) * mask, gripper], dim=1), torch.rand(2, 3)
    with torch.no_grad():
        torch.testing.assert_close(encoder(grid, state), ConvolutionalEncoder.forward(encoder, grid, state))
