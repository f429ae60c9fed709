"""The behaviour-cloning policy: inputs, losses, configuration; `test_equivariance` tests its symmetry."""

import sys

import pytest
import torch
from lerobot.configs.types import NormalizationMode
from lerobot.policies.factory import make_pre_post_processors
from lerobot.scripts import lerobot_eval

from lerobot_policy_symview.configuration import CHOICES, CROP_SIZES
from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.encoders import ENCODERS
from lerobot_policy_symview.equivariance import example_observation
from lerobot_policy_symview.methods import METHODS
from lerobot_policy_symview.model_card import model_card
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.processor_symview_bc import make_symview_bc_pre_post_processors
from lerobot_symview import keys
from lerobot_symview.errors import DivergenceError
from lerobot_symview.runtime.flag_errors import FlagError
from lerobot_symview.views import VIEWS, ReprojectedView
from tests.helpers.packages import registered
from tests.helpers.policies import make_config, make_policy, take_training_steps, training_batch


def act(policy, observation, processors=None):
    preprocess, postprocess = processors or make_symview_bc_pre_post_processors(policy.config)
    return postprocess(policy.select_action(preprocess(dict(observation))))


@pytest.mark.long
@pytest.mark.parametrize("method", METHODS)
def test_training_reduces_the_loss_of_every_method(method):
    losses = take_training_steps(make_policy(method=method), count=15, rate=3e-4)
    assert min(losses[-5:]) < 0.9 * losses[0]


@pytest.mark.parametrize(
    "options",
    [
        {"augmentation": "o2"},
        {"augmentation": "o2", "method": "voxel_equi"},
        {"augmentation": "d4", "method": "reproj_equi_broken"},
        {"gripper_input": "none"},
        {"gripper_input": "vector"},
        {"modality": "rgb", "method": "oracle_equi"},
        {"weight_averaging": 0.9},
    ],
    ids=str,
)
def test_training_works_with_every_option(options):
    losses = take_training_steps(make_policy(**options), count=3)
    assert all(0 < loss < 10 for loss in losses)


def test_point_clouds_train_without_the_grippers_height():
    options = {"gripper_input": "vector", "state_symmetry": ["scalar", "sign"]}
    losses = take_training_steps(make_policy(method="point_cloud_equi", **options), count=6)
    assert losses[-1] < losses[0] / 2


@pytest.mark.long
@pytest.mark.parametrize(
    "method", ["reproj_equi", "sideview_nonequi", "voxel_equi", "point_cloud_equi", "reproj_equi_relaxed"]
)
def test_training_is_bit_identical(method):
    """With several threads, whose order of completion differs from run to run."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    runs = []
    for _ in range(3):
        policy = make_policy(method=method, augmentation="o2")
        take_training_steps(policy, count=2)
        runs.append(policy.state_dict())
    torch.set_num_threads(threads)
    for name, value in runs[0].items():
        assert all(torch.equal(run[name], value) for run in runs[1:]), name


def test_saved_and_loaded_policies_give_the_same_action(tmp_path):
    policy = make_policy(weight_averaging=0.9)
    take_training_steps(policy)
    expected = act(policy, example_observation(policy.config))
    policy.train()
    for part in (policy, *make_symview_bc_pre_post_processors(policy.config)):
        part.save_pretrained(tmp_path)
    loaded = SymviewBcPolicy.from_pretrained(tmp_path)
    processors = make_pre_post_processors(loaded.config, str(tmp_path))
    actual = act(loaded, example_observation(policy.config), processors)
    torch.testing.assert_close(actual, expected, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    ("spoilt", "message"),
    [
        ("weights", r"not finite \(in x, y, z, yaw, aperture\): its weights are not finite"),
        ("averaged", "its weights are not finite"),
        ("state", r"its observation \(observation\.state\) is not finite$"),
        ("both", r"its observation .* is not finite and its weights are not finite"),
        ("overflow", r"\(in z\): a number in its network is too large"),
    ],
)
def test_an_action_that_is_not_finite_is_reported_with_its_cause(spoilt, message):
    policy = make_policy(gripper_input="vector", view="side", weight_averaging=0.9 * (spoilt == "averaged"))
    batch = example_observation(policy.config)
    if spoilt in ("state", "both"):
        batch[keys.STATE][0, 2] = torch.inf
    if spoilt in ("weights", "both", "averaged"):
        next((policy.averaged or policy.network).parameters()).data.fill_(torch.nan)
    if spoilt == "overflow":
        policy.action_width[2] = policy.action_center[2] = 3e38
        policy.scaled_chunk = lambda network, features, noise: torch.ones(1, 1, 5)
    for act in (policy.select_action, policy.predict_action_chunk):
        with pytest.raises(DivergenceError, match=message):
            act(batch)


def test_the_model_card_of_a_policy_on_points_names_no_size_of_an_image():
    card = str(model_card(make_config(method="point_cloud_equi"), 1000, "me/data", {}))
    assert "The observation is the RGBD image of the camera `side`, lifted to points, and the state." in card


@pytest.mark.parametrize("method", ["reproj_equi", "voxel_equi", "point_cloud_equi"])
def test_a_gripper_that_is_nowhere_is_reported(method):
    policy = make_policy(method=method)
    batch = example_observation(policy.config)
    batch[keys.STATE][0, 0] = torch.nan
    with pytest.raises(DivergenceError, match=r"observation\.state\) is not finite"):
        policy.select_action(batch)


@pytest.mark.long
def test_lerobot_eval_of_a_diverged_policy_ends_with_the_reason(tmp_path, monkeypatch):
    policy = make_policy()
    next(policy.network.parameters()).data.fill_(torch.nan)
    for part in (policy, *make_symview_bc_pre_post_processors(policy.config)):
        part.save_pretrained(tmp_path / "policy")
    arguments = ["lerobot-eval", f"--policy.path={tmp_path / 'policy'}", "--policy.device=cpu", "--env.type=symview"]
    arguments += ["--eval.n_episodes=1", "--eval.batch_size=1", f"--output_dir={tmp_path / 'out'}"]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(DivergenceError, match=r"action is not finite .*: its weights are not finite"):
        lerobot_eval.main()


def test_averaged_weights_follow_the_trained_ones_and_give_the_action():
    policy = make_policy(weight_averaging=0.75)
    before = [parameter.clone() for parameter in policy.averaged.parameters()]
    take_training_steps(policy, count=1)
    for old, average, new in zip(before, policy.averaged.parameters(), policy.network.parameters(), strict=True):
        torch.testing.assert_close(average, 0.75 * old + 0.25 * new)
    expected = act(policy, example_observation(policy.config))
    with torch.no_grad():
        for parameter in policy.network.parameters():
            parameter += 1
    torch.testing.assert_close(act(policy, example_observation(policy.config)), expected)


def test_missing_averaged_weights_are_initialised_with_the_trained_ones(tmp_path):
    policy = make_policy()
    expected = act(policy, example_observation(policy.config))
    policy.save_pretrained(tmp_path)
    torch.manual_seed(1)
    loaded = SymviewBcPolicy.from_pretrained(tmp_path, config=make_config(weight_averaging=0.9))
    assert loaded.averaged is not None
    torch.testing.assert_close(act(loaded, example_observation(loaded.config)), expected)


def test_millimetres_and_metres_give_the_same_action():
    policy = make_policy()
    raw = example_observation(policy.config)
    in_millimetres = raw | {policy.config.height_key: raw[policy.config.height_key] * 1000}
    torch.testing.assert_close(act(policy, in_millimetres), act(policy, raw))


def test_one_far_pixel_does_not_change_the_unit_of_depth():
    policy = make_policy(method="sideview_nonequi")
    key = policy.config.height_key
    raw = example_observation(policy.config)
    raw[key][..., 0, 0] = 12.0
    torch.testing.assert_close(act(policy, raw | {key: raw[key] * 1000}), act(policy, raw))


def test_x_and_y_share_an_action_scale():
    policy = make_policy()
    torch.testing.assert_close(policy.action_width, torch.tensor([0.05, 0.05, 0.05, 0.7, 0.5]))
    torch.testing.assert_close(policy.action_center, torch.tensor([0.0, 0.0, 0.0, 0.0, 0.5]))


def test_losses_are_available_per_sample():
    policy = make_policy(method="reproj_equi_relaxed").eval()
    batch = training_batch(policy.config)
    each, _ = policy.forward(dict(batch), reduction="none")
    mean, output = policy.forward(dict(batch))
    assert each.shape == (4,)
    torch.testing.assert_close(each.mean(), mean)
    assert output == {"asymmetry": 0.0}


def test_training_noise_changes_only_the_aperture(monkeypatch):
    states = []
    original = SymviewBcPolicy.network_input
    monkeypatch.setattr(
        SymviewBcPolicy,
        "network_input",
        lambda self, batch, *others: states.append(batch[keys.STATE]) or original(self, batch, *others),
    )
    policy = make_policy(aperture_noise=0.03)
    batch = training_batch(policy.config, batch=200)
    before = batch[keys.STATE].clone()
    policy.train().forward(dict(batch))
    policy.eval().forward(dict(batch))
    added = states[0] - before
    assert (added[:, :4] == 0).all()
    assert 0.02 < added[:, 4].std() < 0.04
    assert (states[1] == before).all()
    assert (batch[keys.STATE] == before).all()


@pytest.mark.parametrize("noise", [-0.1, float("nan"), float("inf")])
def test_invalid_noise_raises(noise):
    with pytest.raises(FlagError, match="aperture_noise must be finite and at least 0"):
        make_config(aperture_noise=noise)


def test_noise_without_an_aperture_raises():
    with pytest.raises(FlagError, match="needs a dimension `aperture` in --policy"):
        make_config(aperture_noise=0.1, state_symmetry=["x", "y", "z"], gripper_input="vector")


PARAMETER_COUNTS = {
    "reproj_equi": 1_113_098,
    "persp_equi": 1_113_050,
    "sideview_equi": 1_113_242,
    "oracle_equi": 1_113_098,
    "sideview_nonequi": 1_132_565,
    "sideview_plucker": 1_133_429,  # 6 x 9 weights for each of the first 16 channels more
    "voxel_equi": 1_178_450,
    "point_cloud_equi": 1_178_882,
    "reproj_equi_relaxed": 1_669_354,
    "persp_equi_relaxed": 1_669_282,
    "reproj_equi_broken": 1_113_194,
    "persp_equi_broken": 1_113_146,
}


@pytest.mark.parametrize("method", METHODS)
def test_parameter_counts_of_policies_are_unchanged(method):
    """With the default heads and inputs."""
    policy = SymviewBcPolicy(make_config(method=method, width=64, crop_size=128))
    assert policy.parameter_count == PARAMETER_COUNTS[method]


ENCODER_PARAMETER_COUNTS = {
    "reproj_equi": 1_112_680,
    "sideview_nonequi": 1_130_560,
    "reproj_equi_relaxed": 1_668_888,
    "voxel_equi": 1_177_964,
    "point_cloud_equi": 1_178_464,
}


@pytest.mark.parametrize(("method", "parameters"), ENCODER_PARAMETER_COUNTS.items())
def test_encoders_have_the_papers_parameter_counts(method, parameters):
    """For the paper's five channels; here the voxel and point-cloud encoders get no state."""
    has_point_input = method in ("voxel_equi", "point_cloud_equi")
    options = {"state_symmetry": [], "gripper_input": "vector"} if has_point_input else {"gripper_input": "none"}
    config = make_config(method=method, width=64, crop_size=128, **options)
    policy = SymviewBcPolicy(config)
    assert sum(parameter.numel() for parameter in policy.network.encoder.parameters()) == parameters


def test_the_head_has_the_papers_parameter_count():
    policy = SymviewBcPolicy(make_config(width=64, crop_size=128))
    assert sum(parameter.numel() for parameter in policy.network.head.parameters()) == 322


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "reproj"}, "did you mean 'reproj_equi'"),
        ({"view": "reprojj"}, "did you mean 'reproj'"),
        ({"encoder": "transformer"}, "expected one of: equivariant"),
        ({"view": "persp"}, "has no height map: use --policy.modality=rgb"),
        ({"width": 12}, "multiple of 16"),
        ({"crop_size": 100}, "expected one of: 64, 128"),
        ({"weight_averaging": 1.0}, "below 1"),
        ({"augmentation": "group", "method": "sideview_nonequi"}, "group is the identity with --policy.group=C1"),
        ({"augmentation": "so2", "gripper_input": "none"}, "is not an input .*--policy.gripper_input=none"),
        (
            {"augmentation": "d4", "gripper_input": "vector", "state_symmetry": ["x", "y"]},
            r"is not an input .*--policy.state_symmetry=\['x', 'y'\].* use --policy.augmentation=none",
        ),
        (
            {"normalization_mapping": {"ACTION": NormalizationMode.MEAN_STD}},
            "must be IDENTITY for ACTION, got .*MEAN_STD",
        ),
        ({"normalization_mapping": {"STATE": NormalizationMode.MIN_MAX}}, "must be IDENTITY for STATE"),
        ({"group": "C1"}, "the plain encoder has the group C1"),
        ({"method": "sideview_nonequi", "group": "D4"}, "the plain encoder has the group C1"),
        ({"method": "voxel_equi", "group": "D8"}, "use --policy.group=D4"),
        ({"encoder": "voxel"}, "use --policy.view=side"),
        ({"view": "side"}, "or --policy.method=sideview_equi"),
        ({"state_symmetry": ["x", "y", "z"]}, "lacks yaw, and .* turns it: use --policy.gripper_input=vector"),
    ],
)
def test_invalid_configuration_errors_name_the_flag(options, message):
    with pytest.raises(FlagError, match=message):
        SymviewBcConfig(device="cpu", **options)


@pytest.mark.parametrize("shape", [(60, 152), (152, 60)])
def test_images_must_be_as_large_as_the_crop_in_both_dimensions(shape):
    config = SymviewBcConfig(device="cpu", method="sideview_equi", modality="rgb", crop_size=64)
    numbers = {"dtype": "float32", "shape": (5,), "names": None}
    image = {"dtype": "image", "shape": (*shape, 3), "names": None}
    with pytest.raises(ValueError, match=r"--policy\.crop_size=64 is larger than the 60 px"):
        config.set_dataset_feature_metadata({keys.STATE: numbers, keys.ACTION: numbers, keys.rgb("side"): image})


def test_bfloat16_changes_actions_only_slightly():
    policy = make_policy()
    expected = act(policy, example_observation(policy.config))
    policy.config.dtype = "bfloat16"
    actual = act(policy, example_observation(policy.config))
    assert actual.dtype == torch.float32
    assert 0 < (actual - expected).abs().max() < 0.1 * expected.abs().max()


@pytest.mark.parametrize("method", ["voxel_equi", "reproj_equi_broken"])
def test_configured_calibration_replaces_the_observations(method):
    policy = make_policy(method=method)
    raw = example_observation(policy.config)
    expected = act(policy, raw)
    k, pose = (raw.pop(key)[0] for key in (keys.intrinsics("side"), keys.world_from_cam("side")))
    with pytest.raises(KeyError, match=r"needs .*intrinsics.*--policy.camera.*--rename_map"):
        act(policy, raw)
    side = {
        "height": 152,
        "width": 152,
        "intrinsics": k.view(3, 3).tolist(),
        "world_from_cam": pose.view(4, 4).tolist(),
    }
    calibrated = make_policy(method=method, calibration={"units": "m", "cameras": {"side": side}})
    torch.testing.assert_close(act(calibrated, raw), expected, rtol=1e-4, atol=1e-6)


def test_given_options_take_precedence_over_the_methods():
    config = SymviewBcConfig(device="cpu", method="sideview_equi", modality="rgb", encoder="plain")
    assert (config.view.name, config.modality, config.encoder, config.group) == ("side", "rgb", "plain", "C1")


def test_side_view_uses_the_named_camera():
    config = SymviewBcConfig(device="cpu", method="sideview_equi", camera="left")
    assert config.all_raw_keys == [keys.rgb("left"), keys.depth("left")]


def test_configuration_choices_match_the_networks():
    for encoder in ENCODERS.builtin:
        assert ENCODERS[encoder]
    for crop_size in CROP_SIZES:
        SymviewBcPolicy(make_config(crop_size=crop_size))
    for preset in METHODS.values():
        assert all(value in CHOICES[name] for name, value in preset.items() if name in CHOICES)


def test_registered_views_are_choices():
    with registered(VIEWS, "other", ReprojectedView):
        assert [spec.name for spec in make_config(view="other", modality="rgb").views_to_make] == ["other"]
        with pytest.raises(FlagError, match="did you mean 'other'"):
            make_config(view="othr", modality="rgb")
