"""`--policy.camera_augmentation`: errors of cameras in training, and none when a policy acts."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from scipy.spatial.transform import Rotation

from lerobot_policy_symview import SymviewSacfdConfig, ViewsProcessorStep
from lerobot_policy_symview.inputs.camera_augmentation import augment
from lerobot_policy_symview.inputs.observed_camera import ObservedCamera
from lerobot_policy_symview.processor_pipelines import make_processors
from lerobot_symview import keys, reproject
from lerobot_symview.datasets.features import calibration_vectors
from lerobot_symview.geometry.camera import DepthSensor, stored_camera
from lerobot_symview.geometry.lens import PLUMB_BOB, Lens
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.flag_errors import FlagError
from tests.helpers.cameras import make_camera, plane_depth
from tests.helpers.policies import make_config
from tests.helpers.training import train

CAMERA, COUNT = make_camera(size=96), 40
AUGMENTED = "--policy.camera_augmentation=1"
VIEW = {"name": "reproj", "size": 32, "clip": "none"}


def observation(camera=CAMERA, count=COUNT):
    generator = torch.Generator().manual_seed(0)
    depth = torch.from_numpy(plane_depth(camera).astype(np.float32))
    depth[:10] = 0
    calibration = {
        key: torch.from_numpy(value).expand(count, -1) for key, value in calibration_vectors("side", camera).items()
    }
    return calibration | {
        keys.rgb("side"): torch.rand(count, 3, 96, 96, generator=generator),
        keys.depth("side"): depth.expand(count, 1, -1, -1).clone(),
        keys.STATE: torch.zeros(count, 5),
    }


def augmented(strength=1.0, seed=0, camera=CAMERA, fixed=None, **changes):
    torch.manual_seed(seed)
    item = {key: value for key, value in (observation(camera) | changes).items() if value is not None}
    return augment(item, [ObservedCamera("side", fixed)], strength)


def cameras(item):
    names = keys.calibration("side", item)
    columns = zip(*(item[name].numpy() for name in names), strict=True)
    return [
        stored_camera(height=96, width=96, **dict(zip(map(keys.parameter, names), row, strict=True))) for row in columns
    ]


def test_no_strength_changes_nothing():
    for key, value in augmented(0.0).items():
        torch.testing.assert_close(value, observation()[key], rtol=0, atol=1e-7)


@pytest.mark.parametrize("strength", [1.0, 2.0])
def test_calibrations_have_errors_up_to_their_limits(strength):
    made = cameras(augmented(strength))
    distances = np.array([np.linalg.norm(camera.position - CAMERA.position) for camera in made])
    rotations = [camera.world_from_cam[:3, :3] @ CAMERA.world_from_cam[:3, :3].T for camera in made]
    degrees = np.rad2deg([np.linalg.norm(Rotation.from_matrix(rotation).as_rotvec()) for rotation in rotations])
    focal = np.array([abs(camera.fx / CAMERA.fx - 1) for camera in made])
    for errors, largest in ((distances, 0.01), (degrees, 1.0), (focal, 0.01)):
        assert errors.max() <= 1.001 * strength * largest
        assert errors.max() > 0.8 * strength * largest
        assert len(set(errors.round(9))) == COUNT  # every frame has its own


def test_depth_has_noise_and_holes_and_no_new_points():
    exact, made = observation()[keys.depth("side")], augmented()[keys.depth("side")]
    assert (made[exact == 0] == 0).all()
    kept = (made > 0) & (exact > 0)
    noise = ((made - exact) / exact**2)[kept]
    assert noise.std().item() == pytest.approx(0.0025, rel=0.05)
    assert abs(noise.mean().item()) < 1e-4
    lost = ((made == 0) & (exact > 0)).flatten(1).sum(1) / (exact > 0).flatten(1).sum(1)
    assert lost.median().item() == pytest.approx(0.05, abs=0.02)
    assert lost.max() < 0.05 + 1.5 * 0.3**2


def test_a_rectangle_hides_a_part_of_half_of_the_images():
    color, depth = (augmented()[key(camera)] for key, camera in ((keys.rgb, "side"), (keys.depth, "side")))
    changed = (color != observation()[keys.rgb("side")]).any(dim=1)
    shares = changed.flatten(1).float().mean(1)
    assert 0.25 < (shares > 0).float().mean() < 0.75
    assert shares.max() <= 0.32**2
    for mask, image in zip(changed, depth, strict=True):
        rows, columns = (mask.any(dim=axis).nonzero().flatten() for axis in (1, 0))
        if len(rows):
            assert mask[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1].all()
            assert (image[0][mask] == 0).all()


def test_errors_follow_from_the_seed():
    first, again, other = augmented(seed=1), augmented(seed=1), augmented(seed=2)
    for key in (keys.rgb("side"), keys.depth("side"), keys.world_from_cam("side")):
        assert torch.equal(first[key], again[key])
        assert not torch.equal(first[key], other[key])


def test_a_fixed_camera_keeps_its_lens_and_depth_sensor():
    lens = Lens(PLUMB_BOB, (-0.1, 0.02, 0.001, 0.0))
    camera = replace(CAMERA, lens=lens, depth_sensor=DepthSensor(CAMERA.intrinsics, np.eye(4)))
    made = augmented(fixed=camera, **dict.fromkeys(keys.calibration("side", ())))
    assert {keys.parameter(key) for key in keys.calibration("side", made)} == {
        "intrinsics", "world_from_cam", "distortion", "depth_intrinsics", "color_from_depth"
    }  # fmt: skip
    assert all(each.lens == cameras(made)[0].lens is not None for each in cameras(made))


def test_views_are_those_of_the_augmented_images(monkeypatch):
    """Views in the dataset are made anew with an action, and kept without one."""
    stored = observation(count=3) | {keys.view("side", output): torch.zeros(3, 3, 32, 32) for output in ("reproj",)}
    stored[keys.view("side", "reproj_height")] = torch.zeros(3, 1, 32, 32)
    step = ViewsProcessorStep(views=[VIEW], augmentation=1.0)
    acting = step({"observation": dict(stored), "action": None})["observation"]
    assert not acting[keys.view("side", "reproj")].any()
    torch.manual_seed(5)
    made = step({"observation": dict(stored), "action": torch.zeros(3, 5)})["observation"]
    for index, camera in enumerate(cameras(made)):
        rgb = (made[keys.rgb("side")][index] * 255).round().byte().permute(1, 2, 0).numpy()
        expected = reproject(rgb, made[keys.depth("side")][index, 0].numpy(), camera, Workspace(), size=32)
        np.testing.assert_array_equal(made[keys.view("side", "reproj_height")][index, 0].numpy(), expected.height)
    assert (made[keys.world_from_cam("side")] != stored[keys.world_from_cam("side")]).any()
    assert (made[keys.rgb("side")].shape, made[keys.STATE].shape) == ((3, 3, 96, 96), (3, 5))


@pytest.mark.parametrize("method", ["reproj_equi", "persp_equi", "voxel_equi", "sideview_plucker"])
def test_every_input_of_a_camera_is_augmented(method):
    config = make_config(method=method, camera_augmentation=1.0)
    preprocessor, _ = make_processors(config)
    item = observation(count=2)
    batches = []
    for action in (torch.zeros(2, 5), None):
        torch.manual_seed(0)
        batches.append(preprocessor(item | ({} if action is None else {keys.ACTION: action})))
    changed = {
        key for key, value in batches[1].items() if torch.is_tensor(value) and not torch.equal(batches[0][key], value)
    }
    assert {keys.rgb("side"), keys.depth("side"), keys.intrinsics("side"), keys.world_from_cam("side")} <= changed
    assert config.is_computed == (config.color_key in changed - {keys.rgb("side")})


@pytest.mark.long
def test_lerobot_trains_with_augmentation_and_what_cannot_have_it_is_refused(
    recorded, with_views, only_views, tmp_path, monkeypatch
):
    for name, dataset in (("raw", recorded), ("views", with_views)):
        checkpoint = train(monkeypatch, dataset, tmp_path / name, AUGMENTED)
        assert PreTrainedConfig.from_pretrained(checkpoint).camera_augmentation == 1.0
    with pytest.raises(ValueError, match=r"camera_augmentation makes views anew from .* which the dataset lacks"):
        train(monkeypatch, only_views, tmp_path / "never", AUGMENTED)


def test_policies_that_cannot_be_augmented_are_refused():
    with pytest.raises(FlagError, match="is for cloned policies"):
        SymviewSacfdConfig(camera_augmentation=1.0)
    for options in ({"method": "oracle_equi"}, {"view": {"name": "reproj", "memory": True}}):
        with pytest.raises(FlagError, match=r"it is not for --policy\.view=top and for views with memory"):
            make_config(camera_augmentation=1.0, **options)
