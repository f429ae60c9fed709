"""The equivariance of every method's policy, from the raw observation to the action sent to the robot."""

import pytest
import torch
from lerobot.configs.types import NormalizationMode
from lerobot.envs.utils import preprocess_observation
from lerobot.policies.factory import make_pre_post_processors

from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.equivariance import (
    assert_equivariant,
    checked_group,
    equivariance_errors,
    example_observation,
    transform_observation,
)
from lerobot_policy_symview.inputs.scene_input import PointInput
from lerobot_policy_symview.methods import METHODS
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.processor_symview_bc import make_symview_bc_pre_post_processors
from lerobot_policy_symview.symmetry.representations import types_of
from lerobot_policy_symview.symmetry.transforms import PlanarTransform
from lerobot_symview import keys
from lerobot_symview.geometry.lens import PLUMB_BOB, Lens
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.kinematics.arm import INCREMENT, STATE
from lerobot_symview.views import ViewSpec
from symview_sim.settings import EnvSettings
from tests.helpers.arms import so101_arm
from tests.helpers.policies import make_config, make_policy, take_training_steps, training_batch

BROKEN = [method for method in METHODS if method.endswith("_broken")]
RELAXED = [method for method in METHODS if method.endswith("_relaxed")]
NONEQUIVARIANT = ["sideview_nonequi", "sideview_plucker"]
EQUIVARIANT = [method for method in METHODS if method not in BROKEN + RELAXED + NONEQUIVARIANT]


@pytest.mark.long
@pytest.mark.parametrize("method", EQUIVARIANT)
def test_methods_are_equivariant_before_and_after_training_and_loading(method, tmp_path):
    policy = make_policy(method=method)
    assert_equivariant(policy)
    take_training_steps(policy)
    assert policy.training
    assert_equivariant(policy)
    assert policy.training
    for part in (policy, *make_symview_bc_pre_post_processors(policy.config)):
        part.save_pretrained(tmp_path)
    loaded = SymviewBcPolicy.from_pretrained(tmp_path)
    assert_equivariant(loaded, make_pre_post_processors(loaded.config, str(tmp_path)))
    assert_equivariant(loaded.double(), tolerance=1e-10)


def test_a_policy_that_drives_joints_is_checked_on_the_grippers_poses():
    types = types_of(STATE)
    policy = make_policy(arm=so101_arm().plain(), state_symmetry=types, action_symmetry=types_of(INCREMENT))
    assert_equivariant(policy)
    assert policy.config.arm


@pytest.mark.long
@pytest.mark.parametrize("method", EQUIVARIANT)
def test_training_loss_is_invariant(method, monkeypatch):
    """In training mode without randomness: images have the crop's size, and points are sampled with the same seed."""
    monkeypatch.setattr(PointInput, "_margin", 0.0)
    policy = make_policy(method=method).double().train()
    config = policy.config
    batch = {key: value.double() for key, value in training_batch(config).items()}
    if method not in ("voxel_equi", "point_cloud_equi"):
        batch |= {key: image[..., :64, :64] for key, image in batch.items() if image.ndim == 4}
    group = checked_group(config)

    def losses(observation):
        torch.manual_seed(0)
        return policy.forward(observation, reduction="none")[0]

    expected = losses(dict(batch))
    for element in range(1, group.size):
        transform = PlanarTransform.of_element(group, element, batch[keys.ACTION])
        transformed = transform_observation(batch, config, group, element)
        transformed[keys.ACTION] = config.actions.transform(batch[keys.ACTION], transform, absolute_yaw=False)
        torch.testing.assert_close(losses(transformed), expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("method", NONEQUIVARIANT)
def test_plain_network_is_not_equivariant(method):
    policy = make_policy(method=method)
    take_training_steps(policy)
    assert min(equivariance_errors(policy).values()) > 0.05
    with pytest.raises(AssertionError, match=rf"{method}.*not equivariant within 0.0001: rotated by 90 degrees"):
        assert_equivariant(policy)


@pytest.mark.parametrize("method", RELAXED)
def test_relaxed_networks_are_equivariant_only_before_training(method):
    policy = make_policy(method=method)
    assert_equivariant(policy)
    take_training_steps(policy, count=20)
    assert max(equivariance_errors(policy).values()) > 1e-3


@pytest.mark.parametrize("method", BROKEN)
def test_camera_direction_breaks_the_symmetry_unless_the_camera_moves_with_the_scene(method):
    policy = make_policy(method=method)
    take_training_steps(policy)
    assert_equivariant(policy, camera="moves")
    with pytest.raises(AssertionError, match="not equivariant"):
        assert_equivariant(policy)
    errors = equivariance_errors(policy)
    assert errors[4] < 1e-4  # the camera lies in the reflection's plane y = 0
    assert min(error for element, error in errors.items() if element != 4) > 0.01


@pytest.mark.parametrize("group", ["C4", "D8", "C8"])
def test_other_groups_are_exact_for_elements_that_map_pixels_onto_pixels(group):
    policy = make_policy(group=group)
    take_training_steps(policy)
    assert_equivariant(policy)
    errors = equivariance_errors(policy)
    assert len(errors) == {"C4": 3, "D8": 15, "C8": 7}[group]
    assert all(error > 1e-3 for element, error in errors.items() if group != "C4" and element % 2)


def test_bfloat16_autocast_is_equivariant_within_its_precision():
    policy = make_policy()
    take_training_steps(policy)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert max(equivariance_errors(policy).values()) < 5e-2
        assert_equivariant(policy)


@pytest.mark.parametrize(
    "method", [method for method in EQUIVARIANT if method not in ("voxel_equi", "point_cloud_equi")]
)
def test_bfloat16_policies_are_equivariant_within_its_precision(method):
    policy, exact = make_policy(method=method, dtype="bfloat16"), make_policy(method=method)
    raw = example_observation(policy.config)
    difference = policy.select_action(dict(raw)) - exact.select_action(dict(raw))
    assert difference.abs().max() > 1e-5  # it does compute in bfloat16
    assert_equivariant(policy)


def test_different_scales_of_x_and_y_break_equivariance():
    policy = make_policy()
    policy.action_width[0] *= 2
    with pytest.raises(AssertionError, match="rotated by 90 degrees"):
        assert_equivariant(policy)


@pytest.mark.parametrize("mode", [NormalizationMode.MEAN_STD, NormalizationMode.MIN_MAX])
def test_lerobots_normalisation_of_actions_breaks_equivariance(mode):
    """LeRobot scales every dimension by its own statistics; the policy's configuration disables that."""
    policy = make_policy()
    policy.config.normalization_mapping["ACTION"] = mode
    scale = torch.tensor([0.03, 0.02, 0.03, 0.4, 0.5])
    stats = {keys.ACTION: {"mean": torch.zeros(5), "std": scale, "min": -scale, "max": scale}}
    with pytest.raises(AssertionError, match="rotated by 90 degrees"):
        assert_equivariant(policy, make_symview_bc_pre_post_processors(policy.config, stats))


def test_trivial_theta_has_the_wrong_yaw_under_reflection():
    errors = equivariance_errors(make_policy(theta_representation="trivial"))
    assert max(errors[element] for element in (1, 2, 3)) < 1e-4
    assert min(errors[element] for element in (4, 5, 6, 7)) > 0.5


def test_another_robot_needs_only_another_declaration():
    """Seven dimensions in another order, with a rotation vector; the state lacks the gripper's pose."""
    policy = make_policy(
        action_symmetry=["aperture", "ry", "yaw", "y", "z", "x", "rx"],
        state_symmetry=["scalar", "y:wrist", "x:wrist", "z", "sign"],
        gripper_input="vector",
        view=ViewSpec("reproj", {"clip": "none"}),
    )
    take_training_steps(policy)
    assert_equivariant(policy)
    wrong = make_policy(
        action_symmetry=["aperture", "ry", "yaw", "x", "z", "y", "rx"],
        state_symmetry=policy.config.state_symmetry,
        gripper_input="vector",
        view=ViewSpec("reproj", {"clip": "none"}),
    )
    wrong.load_state_dict(policy.state_dict())
    wrong.config.action_symmetry = policy.config.action_symmetry
    with pytest.raises(AssertionError):
        assert_equivariant(wrong)


@pytest.mark.parametrize(
    ("state", "gripper_input"),
    [
        (["x:left", "y:left", "z:left", "yaw:left", "scalar"], "vector"),
        (["x", "y", "z", "yaw", "aperture", "yaw:r"], "vector"),
        (["x", "y", "z", "yaw", "aperture", "yaw:r"], "image"),
    ],
)
def test_every_orientation_in_the_state_rotates_with_the_scene(state, gripper_input):
    options = {"view": ViewSpec("reproj", {"clip": "none"}), "gripper_input": gripper_input}
    policy = make_policy(state_symmetry=state, **options)
    take_training_steps(policy)
    assert_equivariant(policy)


@pytest.fixture(scope="module")
def raw():
    """A batch of one simulated observation of two cameras, without views."""
    env = EnvSettings(
        "block_picking", more_cameras=(CameraSpec("left", height=96, width=128, azimuth_deg=80.0),)
    ).make()
    observation, _ = env.reset(seed=3)
    env.close()
    batched = {
        key: {name: image[None] for name, image in value.items()} if isinstance(value, dict) else value[None]
        for key, value in observation.items()
    }
    return preprocess_observation(batched)


# a reflection changes which of equally high points a reprojected pixel shows; infill changes the pixels between points
@pytest.mark.parametrize(
    ("method", "options", "rotated_tolerance", "reflected_tolerance"),
    [
        ("persp_equi", {"size": 76}, 1e-4, 1e-4),
        ("persp_equi", {"size": 76, "cameras": ["side", "left"]}, 1e-4, 1e-4),
        ("voxel_equi", {}, 1e-4, 1e-4),
        ("reproj_equi", {"size": 76, "infill": "none"}, 1e-4, 0.1),
        ("reproj_equi", {"size": 76, "infill": "none", "cameras": ["side", "left"]}, 1e-4, 0.1),
        ("reproj_equi", {"size": 76, "infill": "nearest"}, 0.2, 0.2),
    ],
)
def test_policies_are_equivariant_from_the_raw_image(raw, method, options, rotated_tolerance, reflected_tolerance):
    view = ViewSpec(METHODS[method]["view"], options)
    policy = make_policy(method=method, view=view)
    take_training_steps(policy)
    errors = equivariance_errors(policy, observation=raw)
    assert max(errors[element] for element in (1, 2, 3)) < rotated_tolerance
    assert max(errors[element] for element in (4, 5, 6, 7)) < reflected_tolerance
    fixed_camera_errors = equivariance_errors(policy, observation=raw, camera="stays")
    assert max(fixed_camera_errors.values()) > max(rotated_tolerance, reflected_tolerance)


@pytest.mark.parametrize(("method", "options"), [("persp_equi", {"size": 76}), ("voxel_equi", {})])
def test_policies_are_equivariant_from_the_raw_image_of_a_lens(raw, method, options):
    policy = make_policy(method=method, view=ViewSpec(METHODS[method]["view"], options))
    take_training_steps(policy)
    lens = torch.from_numpy(Lens(PLUMB_BOB, (-0.2, 0.05, 0.01, 0.02)).stored()).float()
    observation = raw | {keys.distortion("side"): lens[None]}
    assert max(equivariance_errors(policy, observation=observation).values()) < 1e-4
    preprocess, _ = make_symview_bc_pre_post_processors(policy.config)
    through_lens, straight = (policy.select_action(preprocess(dict(each))) for each in (observation, raw))
    assert not torch.allclose(through_lens, straight, atol=1e-3)


def test_inverse_transform_restores_the_observation():
    config = make_config(method="reproj_equi_broken")
    group = checked_group(config)
    raw = example_observation(config, torch.float64)
    for element in range(group.size):
        there = transform_observation(raw, config, group, element, camera="moves")
        back = transform_observation(there, config, group, int(group.inverse[element]), camera="moves")
        for key, value in raw.items():
            difference = back[key] - value
            if key == keys.STATE:
                difference[:, 3] = torch.sin(difference[:, 3])
            torch.testing.assert_close(difference, torch.zeros_like(difference))


def test_the_plain_method_is_checked_on_d4():
    assert checked_group(SymviewBcConfig(device="cpu", method="sideview_nonequi")).size == 8
