"""Point clouds and voxels of rendered scenes, and PointNet++'s sampling and grouping, against slow references."""

import math

import numpy as np
import pytest
import torch

from lerobot_policy_symview.inputs.clouds import Cloud, cloud_from_depth, gripper_points
from lerobot_policy_symview.inputs.voxels import gripper_voxels, voxelize
from lerobot_policy_symview.nn.encoders.point_cloud import PointEncoder, farthest_points, neighborhoods
from lerobot_policy_symview.symmetry.groups import make_group
from lerobot_policy_symview.symmetry.transforms import PlanarTransform
from lerobot_symview import keys
from lerobot_symview.geometry.camera import Camera, unproject
from lerobot_symview.geometry.gripper import GripperShape, gripper_image
from lerobot_symview.geometry.lens import Lens
from lerobot_symview.geometry.workspace import Workspace
from symview_sim.settings import EnvSettings
from tests.helpers.cameras import make_camera
from tests.helpers.policies import example_observation, make_policy

WORKSPACE = Workspace()


@pytest.fixture(scope="module")
def scene():
    """A rendered frame of block stacking and its calibration."""
    env = EnvSettings("block_stacking").make()
    observation, _ = env.reset(seed=3)
    env.close()
    return observation


def make_cloud(scene, ceiling=1.0, cameras=None):
    return cloud_from_depth(
        torch.from_numpy(scene["pixels"]["side"]).permute(2, 0, 1)[None] / 255,
        torch.from_numpy(scene["images.side_depth"])[None],
        torch.from_numpy(scene["camera.side.intrinsics"])[None],
        torch.from_numpy(scene["camera.side.world_from_cam"])[None],
        WORKSPACE,
        torch.tensor([ceiling]),
        cameras,
    )


def test_points_match_unproject(scene):
    cloud = make_cloud(scene)
    camera = make_camera()
    stored = scene["camera.side.world_from_cam"].reshape(4, 4).astype(np.float64)
    camera = type(camera)(scene["camera.side.intrinsics"].reshape(3, 3).astype(np.float64), stored, 152, 152)
    world = unproject(scene["images.side_depth"][0], camera).reshape(-1, 3)
    expected = world - [*WORKSPACE.center, 0.0]
    valid = cloud.valid[0].numpy()
    np.testing.assert_allclose(cloud.position[0].numpy()[valid], expected[valid], atol=1e-6)
    inside = (np.abs(expected[:, :2]) < 0.2).all(axis=1) & (expected[:, 2] < WORKSPACE.height_limit)
    assert (valid == inside).mean() > 0.9999


def test_points_respect_the_lens(scene):
    lens = Lens("equidistant", (0.05, -0.01, 0.003, -0.0004))
    k, pose = (scene[f"camera.side.{name}"].astype(np.float64) for name in ("intrinsics", "world_from_cam"))
    camera = Camera(k.reshape(3, 3), pose.reshape(4, 4), 152, 152, lens)
    cloud = make_cloud(scene, cameras=[camera])
    expected = unproject(scene["images.side_depth"][0], camera).reshape(-1, 3) - [*WORKSPACE.center, 0.0]
    valid = cloud.valid[0].numpy()
    assert valid.sum() > 1000
    np.testing.assert_allclose(cloud.position[0].numpy()[valid], expected[valid], atol=1e-6)


def test_ceiling_removes_the_arm(scene):
    low = make_cloud(scene, ceiling=0.06)
    assert float(low.position[..., 2].max()) < 0.06
    assert make_cloud(scene).valid.sum() > low.valid.sum() > 1000


def test_invalid_depth_gives_no_valid_point():
    camera = make_camera(size=8)
    depth = torch.full((1, 1, 8, 8), torch.nan)
    depth[..., 0, 0], depth[..., 0, 1], depth[..., 0, 2] = 0.0, torch.inf, -1.0
    cloud = cloud_from_depth(
        torch.rand(1, 3, 8, 8),
        depth,
        torch.tensor(camera.intrinsics).flatten()[None],
        torch.tensor(camera.world_from_cam).flatten()[None],
        WORKSPACE,
        torch.tensor([1.0]),
    )
    assert not cloud.valid.any()
    assert torch.isfinite(cloud.position).all()
    assert (cloud.sample(16, shuffle=False) == 0).all()
    assert (voxelize(cloud, WORKSPACE) == 0).all()


def test_voxels_have_the_mean_colour_of_their_points(scene):
    cloud = make_cloud(scene)
    grid = voxelize(cloud, WORKSPACE)[0].numpy()
    expected: dict[tuple[int, ...], list[np.ndarray]] = {}
    position, color = cloud.position[0].numpy(), cloud.color[0].numpy()
    for point, shade in zip(position[cloud.valid[0]], color[cloud.valid[0]], strict=True):
        x, y, z = math.floor(point[0] / 0.00625) + 32, math.floor(point[1] / 0.00625) + 32, round(point[2] / 0.00625)
        if 0 <= z < 32:
            expected.setdefault((z, x, y), []).append(shade)
    assert grid[0].sum() == len(expected) > 500
    for voxel, shades in expected.items():
        np.testing.assert_allclose(grid[1:, *voxel], np.mean(shades, axis=0), atol=1e-5)


def test_voxels_transform_with_the_scene(scene):
    cloud = make_cloud(scene)
    transform = PlanarTransform(torch.tensor([math.pi / 2], dtype=torch.float64), torch.tensor([True]))
    transformed = voxelize(cloud.transformed(transform), WORKSPACE)
    torch.testing.assert_close(transformed, torch.rot90(voxelize(cloud, WORKSPACE).flip(-1), 1, (-2, -1)))


def test_sampled_points_are_valid_and_repeat_only_if_too_few(scene):
    cloud = make_cloud(scene)
    points = cloud.sample(1024, shuffle=False)
    assert len({tuple(point) for point in points[0].tolist()}) == 1024
    torch.testing.assert_close(points, cloud.sample(1024, shuffle=False))
    assert not torch.equal(points, cloud.sample(1024, shuffle=True))
    some = cloud.valid[0].nonzero()[:10, 0]
    few = Cloud(cloud.position[:, some], cloud.color[:, some], torch.tensor([[True] * 3 + [False] * 7]))
    repeated = few.sample(7, shuffle=True)[0, :, :3]
    assert len({tuple(point) for point in repeated.tolist()}) == 3


def test_farthest_points_and_neighborhoods_match_loops():
    points = torch.rand(2, 40, 3, generator=torch.Generator().manual_seed(0))
    chosen = farthest_points(points, 6)
    for cloud, order in zip(points, chosen, strict=True):
        taken = [0]
        while len(taken) < 6:
            distances = [min(float((cloud[i] - cloud[j]).norm()) for j in taken) for i in range(40)]
            taken.append(int(np.argmax(distances)))
        assert order.tolist() == taken
    squared = torch.cdist(points[:, :5], points).square()
    grouped = neighborhoods(squared, 0.3, 8)
    for scene_index in range(2):
        for center in range(5):
            within = [i for i in range(40) if squared[scene_index, center, i] <= 0.09][:8]
            assert grouped[scene_index, center].tolist() == within + [within[0]] * (8 - len(within))


def test_neighborhoods_fill_their_ball_where_points_are_dense():
    """The nearest 16 points would span the same few millimetres at both radii."""
    generator = torch.Generator().manual_seed(0)
    points = torch.cat([torch.zeros(1, 1, 3), torch.rand(1, 2000, 3, generator=generator) * 2 - 1], dim=1)
    squared = points.square().sum(-1)[:, None]
    for radius in (0.5, 1.0):
        distances = squared[0, 0][neighborhoods(squared, radius, 16)[0, 0]].sqrt()
        assert 0.7 * radius < distances.max() <= radius


POSE = torch.tensor([[0.05, -0.03, 0.1, 0.4, 0.5]], dtype=torch.float64)


def test_gripper_points_are_the_centres_of_the_fingers_of_the_gripper_image():
    drawn = gripper_image(POSE, WORKSPACE, 800)[0].numpy()
    row, column = np.nonzero(drawn)
    drawn_points = (np.stack([row, column], axis=-1) + 0.5) / 800 * WORKSPACE.size - WORKSPACE.size / 2
    axis = np.array([math.cos(0.4), math.sin(0.4)])
    is_first = (drawn_points - POSE[0, :2].numpy()) @ axis < 0
    for point, finger in zip(gripper_points(POSE)[0].numpy(), (is_first, ~is_first), strict=True):
        np.testing.assert_allclose(point, [*drawn_points[finger].mean(0), 0.1], atol=2e-5)


def test_gripper_voxels_are_cubes_around_the_gripper_points():
    grid, edge = gripper_voxels(POSE, WORKSPACE)[0, 0], WORKSPACE.size / 64
    assert grid.sum() * edge**3 == pytest.approx(2 * GripperShape().finger ** 3, rel=0.01)
    points = gripper_points(POSE)[0]
    column, layer = torch.floor(points[:, :2] / edge + 32).long(), torch.floor(points[:, 2] / edge + 0.5).long()
    assert (grid[layer, column[:, 0], column[:, 1]] == 1).all()
    heights = edge * torch.arange(32)
    assert float((grid.sum((1, 2)) * heights).sum() / grid.sum()) == pytest.approx(0.1, abs=1e-6)


def test_the_gripper_is_among_the_sampled_points(scene):
    cloud = make_cloud(scene)
    points = cloud.sample(1024, False, POSE)
    torch.testing.assert_close(points[0, 1:3, :3], gripper_points(POSE)[0].float())
    assert points[0, :, 6].nonzero().flatten().tolist() == [1, 2]
    others = torch.cat([points[:, :1], points[:, 3:]], dim=1)[..., :6]
    torch.testing.assert_close(others, cloud.sample(1022, False))


@pytest.mark.parametrize("height", [0.02, 0.2, 0.25])
def test_the_gripper_is_drawn_at_every_height(height):
    pose = POSE.clone()
    pose[0, 2] = height
    assert gripper_voxels(pose, WORKSPACE).sum() > 0.3 * gripper_voxels(POSE, WORKSPACE).sum()


@pytest.mark.parametrize("method", ["voxel_equi", "point_cloud_equi"])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.0, 0.999), (0.999, 0.3)])
def test_crops_shift_scene_and_gripper_as_they_shift_images(method, offset):
    image_policy, policy = make_policy(method="reproj_equi"), make_policy(method=method)
    batch, images = example_observation(policy.config), example_observation(image_policy.config)
    images[keys.STATE] = batch[keys.STATE]
    offsets = torch.tensor([offset]).expand(len(batch[keys.STATE]), 2)
    drawn = image_policy.scene.form(images, None, offsets)[0][:, -1]
    pixel = WORKSPACE.size / image_policy.config.image_size
    still, moved = (policy.scene.form(batch, None, crop)[0] for crop in (None, offsets))
    torch.testing.assert_close(gripper_center(moved), center(drawn, pixel), atol=pixel, rtol=0)
    shift = gripper_center(moved) - gripper_center(still)
    assert shift.abs().max() > 0.01
    if method == "point_cloud_equi":
        expected = still[..., :2] + shift[:, None]
        torch.testing.assert_close(moved[..., :2], expected, atol=1e-6, rtol=0)


def test_crops_do_not_shift_points_without_the_gripper():
    policy = make_policy(method="point_cloud_equi", gripper_input="vector")
    batch = example_observation(policy.config)
    offsets = torch.zeros(len(batch[keys.STATE]), 2)
    for still, cropped in zip(policy.scene.form(batch), policy.scene.form(batch, None, offsets), strict=True):
        assert torch.equal(still, cropped)


def center(image, pixel):
    """Return the mean position (B, 2), metres, of an image (B, P, P) of weights around the workspace's centre."""
    places = (torch.arange(image.shape[-1]) + 0.5 - image.shape[-1] / 2) * pixel
    weights = image / image.sum((1, 2), keepdim=True)
    return torch.stack([weights.sum(2) @ places, weights.sum(1) @ places], dim=-1)


def gripper_center(observation):
    """Return the mean position (B, 2) of the gripper's voxels or points."""
    if observation.ndim == 5:
        return center(observation[:, 4].sum(1), WORKSPACE.size / 64)
    return observation[:, 1:3, :2].mean(1)


@pytest.mark.parametrize("width", [16, 64])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_features_of_an_untrained_network_are_of_order_one(scene, width, seed):
    """Max pooling adds to them in every abstraction: without normalisation their root mean square is 2 to 4."""
    torch.manual_seed(seed)
    encoder = PointEncoder(make_group("D4"), 3, np.ones((8, 1, 1)), width)
    with torch.no_grad():
        features = encoder(make_cloud(scene).sample(1024, shuffle=False), torch.tensor([[0.5]]))
    assert 0.5 < features.square().mean().sqrt() < 1.8
