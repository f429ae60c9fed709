"""Equivariance of the policy, through its pre- and postprocessor, and what it computes from what."""

import math

import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors

from lerobot_policy_symview.configuration_symview_bc import CROP_SIZES, ENCODER_NAMES, SymviewBcConfig
from lerobot_policy_symview.encoders import ENCODERS, stage_widths
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.processor_symview_bc import make_symview_bc_pre_post_processors
from lerobot_policy_symview.symmetry import mirror, turn
from lerobot_symview import keys

COLOR, HEIGHT = "observation.images.side_reproj", "observation.images.side_reproj_height"
STATS = {
    keys.ACTION: {
        "min": torch.tensor([-0.05, -0.03, -0.05, -0.6, 0.0]),
        "max": torch.tensor([0.04, 0.05, 0.05, 0.7, 1.0]),
    }
}
GROUP = [(turns, flipped) for flipped in (False, True) for turns in range(4)]


def make_policy(**options):
    torch.manual_seed(0)
    config = SymviewBcConfig(device="cpu", width=8, crop_size=64, **options)
    config.output_features = {keys.ACTION: PolicyFeature(FeatureType.ACTION, (len(config.action_symmetry),))}
    policy = SymviewBcPolicy(config, dataset_stats=STATS)
    return policy, *make_symview_bc_pre_post_processors(config)


def observation(batch=2):
    generator = torch.Generator().manual_seed(1)
    state = torch.rand(batch, 5, generator=generator) * torch.tensor([0.3, 0.3, 0.2, 1.5, 1.0])
    return {
        COLOR: torch.rand(batch, 3, 76, 76, generator=generator),
        HEIGHT: torch.rand(batch, 1, 76, 76, generator=generator) * 0.2,
        keys.STATE: state - torch.tensor([0.15, 0.15, -0.02, 0.75, 0.0]),
    }


def act(policy, preprocessor, postprocessor, raw):
    policy.eval()
    return postprocessor(policy.select_action(preprocessor(dict(raw))))


def transformed(raw, config, turns, flipped):
    """The observation of the scene mirrored in y = 0 (or not), then turned."""
    state = mirror(raw[keys.STATE], config.state_symmetry) if flipped else raw[keys.STATE]
    angle = torch.full((len(state),), turns * math.pi / 2)
    images = {key: raw[key].flip(-1) if flipped else raw[key] for key in (COLOR, HEIGHT)}
    return {keys.STATE: turn(state, config.state_symmetry, angle, absolute_yaw=True)} | {
        key: torch.rot90(image, turns, (-2, -1)) for key, image in images.items()
    }


def transformed_action(action, config, turns, flipped):
    action = mirror(action, config.action_symmetry) if flipped else action
    return turn(action, config.action_symmetry, torch.full((len(action),), turns * math.pi / 2), absolute_yaw=False)


def violation(policy, preprocessor, postprocessor, turns, flipped):
    """Largest difference between acting on the transformed scene and transforming the action, relative per entry."""
    raw = observation()
    expected = transformed_action(act(policy, preprocessor, postprocessor, raw), policy.config, turns, flipped)
    actual = act(policy, preprocessor, postprocessor, transformed(raw, policy.config, turns, flipped))
    return float(((actual - expected).abs().amax(0) / expected.abs().amax(0)).max())


def take_training_steps(policy, preprocessor, count=3):
    policy.train()
    optimizer = torch.optim.Adam(policy.parameters(), lr=1e-3)
    for _ in range(count):
        batch = preprocessor(observation() | {keys.ACTION: torch.rand(2, len(policy.config.action_symmetry)) * 0.05})
        loss, _ = policy.forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return loss.item()


@pytest.mark.parametrize(("turns", "flipped"), GROUP)
def test_the_policy_is_equivariant_before_and_after_training(turns, flipped):
    policy, *processors = make_policy()
    assert violation(policy, *processors, turns, flipped) < 1e-4
    take_training_steps(policy, processors[0])
    assert violation(policy, *processors, turns, flipped) < 1e-4


def test_another_order_of_entries_needs_only_another_declaration():
    order = ["aperture", "yaw", "y", "z", "x"]
    policy, *processors = make_policy(action_symmetry=order)
    assert violation(policy, *processors, 1, True) < 1e-4


def test_the_paper_text_turns_yaw_the_wrong_way_in_a_mirror():
    policy, *processors = make_policy(theta_representation="trivial")
    assert violation(policy, *processors, 1, False) < 1e-4
    assert violation(policy, *processors, 0, True) > 1e-2


def test_the_plain_encoder_is_not_equivariant():
    policy, *processors = make_policy(encoder="plain")
    take_training_steps(policy, processors[0])
    assert violation(policy, *processors, 1, False) > 1e-2


def test_scaling_x_and_y_apart_breaks_equivariance():
    policy, *processors = make_policy()
    policy.action_width[0] *= 2
    assert violation(policy, *processors, 1, False) > 1e-2


def test_the_action_scale_is_shared_by_x_and_y():
    policy, *_ = make_policy()
    torch.testing.assert_close(policy.action_width, torch.tensor([0.05, 0.05, 0.05, 0.7, 0.5]))
    torch.testing.assert_close(policy.action_center, torch.tensor([0.0, 0.0, 0.0, 0.0, 0.5]))


@pytest.mark.parametrize(
    "options", [{}, {"rotation_augmentation": True}, {"encoder": "plain"}, {"gripper_input": "none"}]
)
def test_a_policy_overfits_one_batch(options):
    policy, preprocessor, _ = make_policy(**options)
    policy.train()
    batch = preprocessor(
        observation() | {keys.ACTION: torch.tensor([[0.04, 0.0, 0.02, 0.1, 1.0], [0.0, -0.03, 0.0, 0.3, 0.0]])}
    )
    optimizer = torch.optim.Adam(policy.parameters(), lr=3e-3)
    losses = []
    for _ in range(40):
        loss, metrics = policy.forward(batch)
        assert metrics["mse"] == loss.item()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert min(losses[-5:]) < 0.5 * losses[0]


def test_saved_and_loaded_policies_act_alike(tmp_path):
    policy, preprocessor, postprocessor = make_policy()
    take_training_steps(policy, preprocessor)
    expected = act(policy, preprocessor, postprocessor, observation())
    policy.train()
    for part in (policy, preprocessor, postprocessor):
        part.save_pretrained(tmp_path)
    loaded = SymviewBcPolicy.from_pretrained(tmp_path)
    processors = make_pre_post_processors(loaded.config, str(tmp_path))
    torch.testing.assert_close(act(loaded, *processors, observation()), expected, rtol=1e-6, atol=1e-7)


def test_millimetres_and_metres_give_the_same_action():
    policy, *processors = make_policy()
    raw = observation()
    in_millimetres = raw | {HEIGHT: raw[HEIGHT] * 1000}
    torch.testing.assert_close(act(policy, *processors, in_millimetres), act(policy, *processors, raw))


@pytest.mark.parametrize(
    ("encoder", "channels", "parameters"), [("equivariant", 5, 1_112_680), ("plain", 5, 1_130_560)]
)
def test_the_paper_sized_encoders_have_the_papers_parameter_counts(encoder, channels, parameters):
    config = SymviewBcConfig(device="cpu", encoder=encoder, gripper_input="none")
    assert config.channels == channels
    config.output_features = {keys.ACTION: PolicyFeature(FeatureType.ACTION, (5,))}
    config.pretrained_path = "loaded later"  # skips the initialisation, which takes seconds
    network = SymviewBcPolicy(config).network
    head = network.head if encoder == "equivariant" else network.encoder[-1]
    count = sum(p.numel() for p in network.parameters()) - sum(p.numel() for p in head.parameters())
    assert count == parameters


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"view": "reprojj"}, "did you mean 'reproj'"),
        ({"encoder": "transformer"}, "expected one of: equivariant"),
        ({"view": "persp"}, "has no height; use --policy.modality=rgb"),
        ({"width": 12}, "multiple of 8"),
        ({"crop_size": 100}, "one of 64, 128"),
    ],
)
def test_impossible_configurations_are_refused_by_their_flag(options, message):
    with pytest.raises(ValueError, match=message):
        SymviewBcConfig(device="cpu", **options)


def test_the_configuration_offers_what_the_networks_have():
    assert tuple(ENCODERS) == ENCODER_NAMES
    assert all(stage_widths(crop_size, 64) for crop_size in CROP_SIZES)
