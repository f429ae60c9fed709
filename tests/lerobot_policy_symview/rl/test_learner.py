"""Symmetry of actor and critic, and the updates against the equations written out."""

import math

import numpy as np
import pytest
import torch
from torch.distributions import Normal, TanhTransform, TransformedDistribution

from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.equivariance import (
    assert_equivariant,
    checked_group,
    equivariance_errors,
    transform_observation,
)
from lerobot_policy_symview.methods import METHODS
from lerobot_policy_symview.modeling_symview_sacfd import SymviewSacfdPolicy, log_prob_of
from lerobot_policy_symview.rl.learner import METRICS, Learner
from lerobot_policy_symview.rl.replay import Sample
from lerobot_policy_symview.symmetry.transforms import PlanarTransform
from lerobot_symview import keys
from tests.helpers.policies import STATS, make_actor, make_config, training_batch
from tests.lerobot_policy_symview.test_equivariance import EQUIVARIANT

pytestmark = pytest.mark.long

BATCH = 6


def make_sample(
    learner, terminal=(False, True, False, False, True, False), is_demo=(True, True, False, False, False, True)
):
    """Transitions with random actions, and a reward of 1 where terminal."""
    batch = training_batch(learner.config, batch=2 * BATCH)
    packed = learner.codec.pack(batch)
    generator = torch.Generator().manual_seed(2)
    return Sample(
        slots=np.arange(BATCH),
        frames={name: torch.from_numpy(np.stack([frame[name] for frame in packed])) for name in packed[0]},
        action=2 * torch.rand(BATCH, 5, generator=generator) - 1,
        reward=torch.tensor(terminal).float(),
        terminal=torch.tensor(terminal),
        is_demo=torch.tensor(is_demo),
        weight=torch.rand(BATCH, generator=generator) + 0.1,
    )


@pytest.mark.parametrize("method", METHODS)
def test_updates_lower_the_critic_loss_of_every_method(method):
    """Repeated updates on one batch."""
    learner = Learner(make_actor(method=method, augmentation="none"))
    sample = make_sample(learner)
    metrics = [learner.update(sample)[1] for _ in range(6)]
    assert set(metrics[0]) == set(METRICS)
    assert min(row["critic_loss"] for row in metrics[-3:]) < 0.95 * metrics[0]["critic_loss"]
    assert all(math.isfinite(value) for row in metrics for value in row.values())


@pytest.mark.parametrize("method", EQUIVARIANT)
def test_the_actor_is_equivariant_and_the_critic_invariant_after_updates(method):
    """Q-values are unchanged if scene and action are transformed together, and change if only the scene is."""
    learner = Learner(make_actor(method=method))
    sample = make_sample(learner)
    for _ in range(2):
        learner.update(sample)
    assert_equivariant(learner.policy)
    learner.double().eval()
    config, group = learner.config, checked_group(learner.config)
    raw = {key: value.double() for key, value in training_batch(config, batch=2).items()}
    action = learner.policy.scaled(raw[keys.ACTION])

    def q(batch, action):
        with torch.no_grad():
            return learner.critic.q_functions(learner.critic.encoder(*learner.policy.network_input(batch)), action)

    expected = q(raw, action)
    for element in (1, group.rotations, group.size - 1):  # a rotation and a reflection generate the others
        transformed = transform_observation(raw, config, group, element)
        transformed_action = config.actions.transform(
            action, PlanarTransform.of_element(group, element, action), absolute_yaw=False
        )
        torch.testing.assert_close(q(transformed, transformed_action), expected, rtol=1e-9, atol=1e-11)
        assert (q(transformed, action) - expected).abs().max() > 1e-6


def test_the_action_distribution_is_equivariant():
    """Means transform like actions; standard deviations are invariant, and x and y share one."""
    policy = make_actor().double()
    config, group = policy.config, checked_group(policy.config)
    raw = {key: value.double() for key, value in training_batch(config).items()}
    mean, log_std = policy.network(*policy.network_input(raw))
    assert torch.equal(log_std[:, 0], log_std[:, 1])
    assert log_std[0].unique().numel() == 4
    for element in range(1, group.size):
        transformed = policy.network(*policy.network_input(transform_observation(raw, config, group, element)))
        transformed_action = config.actions.transform(
            mean, PlanarTransform.of_element(group, element, mean), absolute_yaw=False
        )
        torch.testing.assert_close(transformed[0], transformed_action, rtol=1e-9, atol=1e-11)
        torch.testing.assert_close(transformed[1], log_std, rtol=1e-9, atol=1e-11)


def test_a_new_actor_samples_from_a_standard_normal():
    torch.manual_seed(0)
    policy = SymviewSacfdPolicy(make_config(SymviewSacfdConfig), dataset_stats=STATS)
    for values in policy.network(*policy.network_input(training_batch(policy.config))):
        assert not values.any()


def test_the_plain_actor_is_not_equivariant():
    learner = Learner(make_actor(method="sideview_nonequi"))
    learner.update(make_sample(learner))
    assert min(equivariance_errors(learner.policy).values()) > 0.05


def test_log_probabilities_are_those_of_a_tanh_squashed_gaussian():
    torch.manual_seed(0)
    mean, log_std, noise = torch.randn(3, 100, 5, dtype=torch.float64)
    unsquashed = mean + log_std.exp() * noise
    squashed = TransformedDistribution(Normal(mean, log_std.exp()), TanhTransform(cache_size=1))
    inside = (unsquashed.abs() < 15).all(dim=1)  # beyond, float64 rounds tanh to 1
    expected = squashed.log_prob(torch.tanh(unsquashed)).sum(dim=1)
    torch.testing.assert_close(log_prob_of(unsquashed, noise, log_std)[inside], expected[inside], rtol=1e-6, atol=1e-6)
    assert inside.sum() > 50


def test_entropy_pulls_a_saturated_mean_back():
    mean = torch.tensor([[-20.0, 20.0]], requires_grad=True)
    log_std = torch.zeros(64, 2)
    noise = torch.randn(64, 2, generator=torch.Generator().manual_seed(0))
    log_prob_of(mean + log_std.exp() * noise, noise, log_std).mean().backward()
    torch.testing.assert_close(mean.grad, torch.tensor([[-2.0, 2.0]]))


def test_sampled_actions_are_within_limits_and_differ():
    policy = make_actor()
    batch = training_batch(policy.config)
    torch.manual_seed(0)
    with torch.no_grad():
        first, second = (policy.sample_action(*policy.network_input(batch))[0] for _ in range(2))
    assert first.abs().max() <= 1
    assert (first - second).abs().min() > 0


def test_an_update_matches_the_equations():
    """SAC's losses and SACfD's behaviour-cloning loss for one update, random only in the sampled actions."""
    learner = Learner(make_actor(method="sideview_nonequi", augmentation="none", bc_weight=0.5))
    sample = make_sample(learner)
    frames = learner.codec.unpack(sample.frames, torch.device("cpu"))
    inputs = learner.policy.network_input(frames, crop_offset=torch.full((2 * BATCH, 2), 0.5))
    (observation, next_observation), (state, next_state) = (part.chunk(2) for part in inputs)

    def q(critic, observation, state, action):
        return critic.q_functions(critic.encoder(observation, state), action)

    real = torch.rand
    torch.manual_seed(5)
    torch.rand = lambda *shape, **options: torch.full(shape, 0.5)
    try:
        td_errors, metrics = learner.update(sample)
    finally:
        torch.rand = real

    again = Learner(make_actor(method="sideview_nonequi", augmentation="none", bc_weight=0.5))
    torch.manual_seed(5)
    with torch.no_grad():
        temperature = 0.01
        next_action, next_log_prob = again.policy.sample_action(next_observation, next_state)
        next_q = q(again.critic, next_observation, next_state, next_action).min(dim=1).values
        next_value = next_q - temperature * next_log_prob
        td_target = sample.reward + 0.99 * (1 - sample.terminal.float()) * next_value
        td_error = q(again.critic, observation, state, sample.action) - td_target[:, None]
        pi, log_pi = again.policy.sample_action(observation, state)
        q_pi = q(again.critic, observation, state, pi).min(dim=1).values
        bc_loss = (pi - sample.action).square().mean(dim=1)[sample.is_demo].mean()
        critic_loss = sum((sample.weight * td_error[:, i] ** 2).mean() for i in range(2))
        actor_loss = (temperature * log_pi - q_pi).mean() + 0.5 * bc_loss
    np.testing.assert_allclose(td_errors, td_error.abs().mean(dim=1), rtol=1e-4, atol=1e-5)
    expected = {"critic_loss": critic_loss, "actor_loss": actor_loss, "bc_loss": bc_loss, "entropy": -log_pi.mean()}
    for name, value in expected.items():
        torch.testing.assert_close(metrics[name], value, rtol=1e-4, atol=1e-5)
    # the temperature is tuned to an entropy of -5: Adam's first step is the learning rate along the gradient's sign
    direction = 1 if -log_pi.mean() < -5 else -1
    assert learner.log_temperature.item() == pytest.approx(math.log(0.01) + direction * 1e-3, abs=1e-6)


def test_the_critic_is_updated_by_its_own_loss_only():
    """The actor's loss leaves gradients in the Q-functions, which must not reach the critic's optimiser."""
    ours, other = (Learner(make_actor(method="sideview_nonequi", bc_weight=weight)) for weight in (1.0, 100.0))
    other.load_state_dict(ours.state_dict())
    for learner in (ours, other):
        torch.manual_seed(1)
        learner.update(make_sample(learner))
    for first, second in zip(ours.critic.parameters(), other.critic.parameters(), strict=True):
        assert torch.equal(first, second)


def test_the_critic_encodes_each_observation_once():
    learner = Learner(make_actor(method="sideview_nonequi"))
    calls = []
    learner.critic.encoder.register_forward_hook(lambda *_: calls.append("critic"))
    learner.target.encoder.register_forward_hook(lambda *_: calls.append("target"))
    learner.update(make_sample(learner))
    assert sorted(calls) == ["critic", "target"]


@pytest.mark.parametrize("update", ["polyak", "hard"])
def test_the_target_critic_follows_the_critic(update):
    learner = Learner(make_actor(method="sideview_nonequi", target_update=update, target_tau=0.25, target_interval=3))
    sample = make_sample(learner)
    slow = [parameter.clone() for parameter in learner.target.parameters()]
    for step in range(1, 4):
        learner.update(sample)
        for i, (now, fast) in enumerate(zip(learner.target.parameters(), learner.critic.parameters(), strict=True)):
            expected = slow[i].lerp(fast, 0.25) if update == "polyak" else fast if step == 3 else slow[i]
            torch.testing.assert_close(now, expected)
            slow[i] = now.clone()


def test_augmentation_transforms_actions_with_observations():
    """Quarter turns and reflections keep the norm of (x, y), z, and the absolute value of the yaw."""
    learner = Learner(make_actor(augmentation="d4"))
    sample = make_sample(learner)
    torch.manual_seed(3)
    before, after, action = learner.augment(sample)
    assert not torch.equal(action, sample.action)
    torch.testing.assert_close(action[:, :2].square().sum(dim=1), sample.action[:, :2].square().sum(dim=1))
    torch.testing.assert_close(action[:, 2], sample.action[:, 2])
    torch.testing.assert_close(action[:, 3].abs(), sample.action[:, 3].abs())
    assert all(observation.shape == (BATCH, 5, 64, 64) for observation, _ in (before, after))


def test_packed_frames_keep_colours_and_heights_to_a_tenth_of_a_millimetre():
    learner = Learner(make_actor())
    batch = training_batch(learner.config, batch=3)
    batch[learner.config.color_key] = (batch[learner.config.color_key] * 255).round() / 255
    packed = learner.codec.pack(batch)
    stacked = {name: torch.from_numpy(np.stack([frame[name] for frame in packed])) for name in packed[0]}
    unpacked = learner.codec.unpack(stacked, torch.device("cpu"))
    # the example's images are larger than the network's input, and are averaged down
    height = torch.nn.functional.interpolate(batch[learner.config.height_key], (76, 76), mode="area")
    torch.testing.assert_close(unpacked[learner.config.height_key], height, rtol=0, atol=1e-4)
    color = torch.nn.functional.interpolate(batch[learner.config.color_key], (76, 76), mode="area")
    torch.testing.assert_close(unpacked[learner.config.color_key], color, rtol=0, atol=0.5 / 255 + 1e-6)
    assert torch.equal(unpacked[keys.STATE], batch[keys.STATE])
    assert stacked[learner.config.color_key].dtype == torch.uint8


def test_a_loaded_learner_makes_the_same_updates(tmp_path):
    ours = Learner(make_actor(method="sideview_nonequi", target_update="hard", target_interval=3))
    sample = make_sample(ours)
    for _ in range(2):
        ours.update(sample)
    ours.save(tmp_path)
    other = Learner(make_actor(method="sideview_nonequi", target_update="hard", target_interval=3))
    other.policy.load_state_dict(ours.policy.state_dict())
    other.load(tmp_path)
    for learner in (ours, other):
        torch.manual_seed(1)
        for _ in range(2):
            learner.update(sample)
    for first, second in zip(ours.state_dict().values(), other.state_dict().values(), strict=True):
        assert torch.equal(first, second)


def test_gradients_are_cut_at_their_norm():
    """Adam's first moment tells the gradient's norm: after one step it is a tenth of the gradient."""
    free, cut = (Learner(make_actor(method="sideview_nonequi", grad_clip_norm=norm)) for norm in (None, 1e-3))
    cut.load_state_dict(free.state_dict())
    norms = {}
    for learner in (free, cut):
        torch.manual_seed(1)
        learner.update(make_sample(learner))
        for name in ("actor", "critic"):
            moments = [state["exp_avg"] for state in learner.optimizers[name].state.values()]
            norms[learner, name] = 10 * torch.stack([moment.norm() for moment in moments]).norm().item()
    for name in ("actor", "critic"):
        assert norms[free, name] > 1e-2
        assert norms[cut, name] == pytest.approx(1e-3, rel=1e-3)


def test_the_learning_rates_decay_along_a_cosine_to_zero():
    learner = Learner(make_actor(method="sideview_nonequi", learning_rate_decay="cosine"), steps=4)
    sample, rates = make_sample(learner), []
    for _ in range(5):
        learner.update(sample)
        rates.append({name: optimizer.param_groups[0]["lr"] for name, optimizer in learner.optimizers.items()})
    for name in ("actor", "critic"):
        expected = [1e-3 * (1 + math.cos(math.pi * share)) / 2 for share in (0, 0.25, 0.5, 0.75, 1.0)]
        assert [rate[name] for rate in rates] == pytest.approx(expected, abs=1e-9)
    assert {rate["temperature"] for rate in rates} == {1e-3}
