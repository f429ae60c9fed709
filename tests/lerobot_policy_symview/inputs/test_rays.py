"""Plücker coordinates of a camera's pixels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature

from lerobot_policy_symview.inputs.rays import plucker_rays, transformed_rays
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.symmetry.transforms import PlanarTransform
from lerobot_symview import keys
from lerobot_symview.geometry.camera import unproject
from lerobot_symview.geometry.lens import Lens
from lerobot_symview.geometry.workspace import Workspace
from tests.helpers.cameras import make_camera, plane_depth
from tests.helpers.policies import make_config, training_batch

WORKSPACE = Workspace()
CENTER = np.array([*WORKSPACE.center, 0.0])


def rays(*cameras, size=None):
    camera = cameras[0]
    k, pose = (
        torch.from_numpy(np.stack([getattr(each, name).ravel() for each in cameras]))
        for name in ("intrinsics", "world_from_cam")
    )
    return plucker_rays(k, pose, (camera.height, camera.width), size or (camera.height, camera.width), WORKSPACE)


@pytest.mark.parametrize(("elevation", "azimuth"), [(45, 0), (20, 70), (85, -130)])
def test_points_of_a_pixel_lie_on_its_ray(elevation, azimuth):
    camera = make_camera(elevation, azimuth)
    direction, moment = rays(camera)[0].double().permute(1, 2, 0).numpy().reshape(-1, 2, 3).swapaxes(0, 1)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1, atol=1e-6)
    for height in (0.0, 0.1):
        points = unproject(plane_depth(camera, height), camera).reshape(-1, 3) - CENTER
        np.testing.assert_allclose(np.cross(points, direction), moment, atol=1e-5)
    ahead = ((points - (camera.position - CENTER)) * direction).sum(axis=1)
    assert ahead.min() > -1e-9  # 0 where there is no depth
    assert ahead.max() > 0.5


def test_each_sample_has_the_rays_of_its_own_camera():
    first, second = make_camera(45, 0), make_camera(30, 90)
    together = rays(first, second)
    torch.testing.assert_close(together[:1], rays(first))
    torch.testing.assert_close(together[1:], rays(second))


def test_a_downscaled_pixel_has_the_ray_of_its_centre():
    camera = make_camera(40, 15)
    whole, half = rays(camera), rays(camera, size=(camera.height // 2, camera.width // 2))
    mean = torch.nn.functional.avg_pool2d(whole, 2)
    torch.testing.assert_close(half, mean, atol=1e-5, rtol=0)


LENS = Lens("plumb_bob", (-0.27, 0.05, 0.001, -0.002, 0.0))


def test_rays_respect_the_lens():
    camera = replace(make_camera(45, 0), lens=LENS)
    k, pose = (torch.from_numpy(matrix.reshape(1, -1)) for matrix in (camera.intrinsics, camera.world_from_cam))
    size = (camera.height, camera.width)
    direction = plucker_rays(k, pose, size, size, WORKSPACE, [camera])[0, :3].double().permute(1, 2, 0).numpy()
    points = unproject(np.ones(size), camera) - camera.position
    np.testing.assert_allclose(direction, points / np.linalg.norm(points, axis=-1, keepdims=True), atol=1e-6)


@pytest.mark.parametrize("method", ["sideview_nonequi"])
def test_a_policy_with_rays_reads_the_lens_of_each_observation(method):
    policy = SymviewBcPolicy(make_config(method=method, camera_rays=True))
    batch = training_batch(policy.config)
    key = keys.distortion(policy.config.camera)
    assert policy.scene.optional_keys == [key]
    plain, _ = policy.scene.form(batch)
    none = torch.zeros(len(plain), 9)
    torch.testing.assert_close(policy.scene.form(batch | {key: none})[0], plain, rtol=0, atol=1e-6)
    lens = none.clone()
    lens[0] = torch.from_numpy(LENS.stored())
    images, _ = policy.scene.form(batch | {key: lens})
    torch.testing.assert_close(images[1:], plain[1:], rtol=0, atol=1e-6)
    assert (images[0] - plain[0]).abs().max() > 1e-3
    assert policy.forward(batch | {key: lens})[0].isfinite()


@pytest.mark.parametrize("reflects", [False, True])
@pytest.mark.parametrize("angle", [0.0, 0.7, np.pi / 2])
def test_rays_transform_with_the_scene_and_its_camera(angle, reflects):
    camera = make_camera(40, 15)
    c, s = np.cos(angle), np.sin(angle)
    linear = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.diag([1, -1 if reflects else 1, 1])
    pose = camera.world_from_cam.copy()
    pose[:3, :3], pose[:3, 3] = linear @ pose[:3, :3], CENTER + linear @ (pose[:3, 3] - CENTER)
    size = (camera.height, camera.width)
    k = torch.from_numpy(camera.intrinsics.reshape(1, 9))
    moved = plucker_rays(k, torch.from_numpy(pose.reshape(1, 16)), size, size, WORKSPACE)
    transform = PlanarTransform(torch.tensor([angle], dtype=torch.float32), torch.tensor([reflects]))
    torch.testing.assert_close(transformed_rays(rays(camera), transform), moved, atol=1e-5, rtol=0)


def test_stored_observations_have_the_rays_of_the_cameras_images():
    """Stored images are downscaled, their K is not."""
    config = make_config(method="sideview_plucker")
    batch = training_batch(config)
    config.input_features = {
        keys.rgb("side"): PolicyFeature(FeatureType.VISUAL, tuple(batch[keys.rgb("side")].shape[1:]))
    }
    policy = SymviewBcPolicy(config).eval()
    small = batch | {
        key: policy.scene.downscale(values) for key, values in batch.items() if getattr(values, "ndim", 0) == 4
    }
    assert small[keys.rgb("side")].shape[-1] < batch[keys.rgb("side")].shape[-1]
    direct, stored = (policy.network_input(each)[0] for each in (batch, small))
    assert direct.shape[1] == 10
    torch.testing.assert_close(stored, direct)
