"""Actor and critic: their symmetry, and the updates against formulas written out."""

import math

import numpy as np
import pytest
import torch
from torch.distributions import Normal, TanhTransform, TransformedDistribution

from lerobot_policy_symview.equivariance import (
    assert_equivariant,
    checked_group,
    equivariance_errors,
    transform_observation,
)
from lerobot_policy_symview.methods import METHODS
from lerobot_policy_symview.modeling_symview_sacfd import log_density
from lerobot_policy_symview.rl.learner import MEASURES, Learner
from lerobot_policy_symview.rl.replay import Sample
from lerobot_policy_symview.symmetry.transforms import PlanarTransform
from lerobot_symview import keys
from tests.helpers.policies import make_actor, training_batch
from tests.lerobot_policy_symview.test_equivariance import EQUIVARIANT

pytestmark = pytest.mark.long

BATCH = 6


def make_sample(
    learner, terminal=(False, True, False, False, True, False), expert=(True, True, False, False, False, True)
):
    """Two observations of each transition, actions at random, a reward where nothing follows."""
    batch = training_batch(learner.config, batch=2 * BATCH)
    packed = learner.codec.pack(batch)
    generator = torch.Generator().manual_seed(2)
    return Sample(
        slots=np.arange(BATCH),
        frames={name: torch.from_numpy(np.stack([frame[name] for frame in packed])) for name in packed[0]},
        action=2 * torch.rand(BATCH, 5, generator=generator) - 1,
        reward=torch.tensor(terminal).float(),
        terminal=torch.tensor(terminal),
        expert=torch.tensor(expert),
        weight=torch.rand(BATCH, generator=generator) + 0.1,
    )


@pytest.mark.parametrize("method", METHODS)
def test_every_method_is_updated(method):
    """The values of what is learned by heart come nearer their goals."""
    learner = Learner(make_actor(method=method, augmentation="none"))
    sample = make_sample(learner)
    told = [learner.update(sample)[1] for _ in range(6)]
    assert set(told[0]) == set(MEASURES)
    assert min(one["critic_loss"] for one in told[-3:]) < 0.95 * told[0]["critic_loss"]
    assert all(math.isfinite(value) for one in told for value in one.values())


@pytest.mark.parametrize("method", EQUIVARIANT)
def test_the_actor_is_equivariant_and_the_critic_invariant_after_updates(method):
    """Both values stay when scene and action move together, and do not when the scene moves alone."""
    learner = Learner(make_actor(method=method))
    sample = make_sample(learner)
    for _ in range(2):
        learner.update(sample)
    assert_equivariant(learner.policy)
    learner.double().eval()
    config, group = learner.config, checked_group(learner.config)
    raw = {key: value.double() for key, value in training_batch(config, batch=2).items()}
    action = learner.policy.scaled(raw[keys.ACTION])

    def values(batch, action):
        with torch.no_grad():
            return learner.critic.values(learner.critic.encoder(*learner.policy.network_input(batch)), action)

    expected = values(raw, action)
    for element in (1, group.turns, group.size - 1):  # a turn and a mirror image generate the rest
        moved = transform_observation(raw, config, group, element)
        turned = config.actions.transform(
            action, PlanarTransform.of_element(group, element, action), absolute_yaw=False
        )
        torch.testing.assert_close(values(moved, turned), expected, rtol=1e-9, atol=1e-11)
        assert (values(moved, action) - expected).abs().max() > 1e-6


def test_the_whole_distribution_moves_with_the_scene():
    """Means move like actions, standard deviations stay: x and y have one in common."""
    policy = make_actor().double()
    config, group = policy.config, checked_group(policy.config)
    raw = {key: value.double() for key, value in training_batch(config).items()}
    mean, log_std = policy.network(*policy.network_input(raw))
    assert torch.equal(log_std[:, 0], log_std[:, 1])
    assert log_std[0].unique().numel() == 4
    for element in range(1, group.size):
        moved = policy.network(*policy.network_input(transform_observation(raw, config, group, element)))
        turned = config.actions.transform(mean, PlanarTransform.of_element(group, element, mean), absolute_yaw=False)
        torch.testing.assert_close(moved[0], turned, rtol=1e-9, atol=1e-11)
        torch.testing.assert_close(moved[1], log_std, rtol=1e-9, atol=1e-11)


def test_the_plain_actor_and_critic_have_no_symmetry():
    learner = Learner(make_actor(method="sideview_nonequi"))
    learner.update(make_sample(learner))
    assert min(equivariance_errors(learner.policy).values()) > 0.05


def test_densities_are_those_of_squashed_normal_distributions():
    torch.manual_seed(0)
    mean, log_std, noise = torch.randn(3, 100, 5, dtype=torch.float64)
    drawn = torch.tanh(mean + log_std.exp() * noise)
    squashed = TransformedDistribution(Normal(mean, log_std.exp()), TanhTransform(cache_size=1))
    inside = (drawn.abs() < 0.999).all(dim=1)
    expected = squashed.log_prob(drawn).sum(dim=1)
    torch.testing.assert_close(log_density(drawn, noise, log_std)[inside], expected[inside], rtol=1e-2, atol=1e-2)
    assert inside.sum() > 30


def test_drawn_actions_are_within_limits_and_differ():
    policy = make_actor()
    batch = training_batch(policy.config)
    torch.manual_seed(0)
    with torch.no_grad():
        first, second = (policy.draw(*policy.network_input(batch))[0] for _ in range(2))
    assert first.abs().max() <= 1
    assert (first - second).abs().min() > 0


def test_an_update_is_what_the_formulas_say():
    """SAC's losses and SACfD's term, written out for one update with nothing random but the drawn actions."""
    learner = Learner(make_actor(method="sideview_nonequi", augmentation="none", expert_weight=0.5))
    sample = make_sample(learner)
    frames = learner.codec.unpack(sample.frames, torch.device("cpu"))
    inputs = learner.policy.network_input(frames, place=torch.full((2 * BATCH, 2), 0.5))
    (picture, next_picture), (state, next_state) = (part.chunk(2) for part in inputs)

    def q(critic, picture, state, action):
        return critic.values(critic.encoder(picture, state), action)

    real = torch.rand
    torch.manual_seed(5)
    torch.rand = lambda *shape, **options: torch.full(shape, 0.5)
    try:
        errors, told = learner.update(sample)
    finally:
        torch.rand = real

    again = Learner(make_actor(method="sideview_nonequi", augmentation="none", expert_weight=0.5))
    torch.manual_seed(5)
    with torch.no_grad():
        temperature = 0.01
        following, next_density = again.policy.draw(next_picture, next_state)
        worth = q(again.critic, next_picture, next_state, following).min(dim=1).values - temperature * next_density
        goal = sample.reward + 0.99 * (1 - sample.terminal.float()) * worth
        difference = q(again.critic, picture, state, sample.action) - goal[:, None]
        drawn, density = again.policy.draw(picture, state)
        judged = q(again.critic, picture, state, drawn).min(dim=1).values
        expert = (drawn - sample.action).square().mean(dim=1)[sample.expert].mean()
        critic_loss = sum((sample.weight * difference[:, i] ** 2).mean() for i in range(2))
        actor_loss = (temperature * density - judged).mean() + 0.5 * expert
    np.testing.assert_allclose(errors, difference.abs().mean(dim=1), rtol=1e-4, atol=1e-5)
    expected = {"critic_loss": critic_loss, "actor_loss": actor_loss, "expert_loss": expert, "entropy": -density.mean()}
    for name, value in expected.items():
        torch.testing.assert_close(told[name], value, rtol=1e-4, atol=1e-5)
    # tuned towards an entropy of -5: Adam's first step is the learning rate in the gradient's direction
    direction = 1 if -density.mean() < -5 else -1
    assert learner.log_temperature.item() == pytest.approx(math.log(0.01) + direction * 1e-3, abs=1e-6)


def test_the_critics_last_layers_learn_from_its_own_loss_alone():
    """The actor's loss goes through them and must leave them as they are."""
    ours, other = (Learner(make_actor(method="sideview_nonequi", expert_weight=weight)) for weight in (1.0, 100.0))
    other.load_state_dict(ours.state_dict())
    for learner in (ours, other):
        torch.manual_seed(1)
        learner.update(make_sample(learner))
    for one, two in zip(ours.critic.parameters(), other.critic.parameters(), strict=True):
        assert torch.equal(one, two)


def test_the_critics_convolutions_see_each_observation_once():
    learner = Learner(make_actor(method="sideview_nonequi"))
    seen = []
    learner.critic.encoder.register_forward_hook(lambda *_: seen.append("critic"))
    learner.target.encoder.register_forward_hook(lambda *_: seen.append("target"))
    learner.update(make_sample(learner))
    assert sorted(seen) == ["critic", "target"]


@pytest.mark.parametrize("update", ["polyak", "hard"])
def test_the_target_follows(update):
    learner = Learner(make_actor(method="sideview_nonequi", target_update=update, target_rate=0.25, target_interval=3))
    sample = make_sample(learner)
    slow = [one.clone() for one in learner.target.parameters()]
    for step in range(1, 4):
        learner.update(sample)
        for i, (now, fast) in enumerate(zip(learner.target.parameters(), learner.critic.parameters(), strict=True)):
            expected = slow[i].lerp(fast, 0.25) if update == "polyak" else fast if step == 3 else slow[i]
            torch.testing.assert_close(now, expected)
            slow[i] = now.clone()


def test_augmentation_moves_actions_with_what_is_seen():
    """With quarter turns alone nothing of the loss changes for an equivariant learner but the crop."""
    learner = Learner(make_actor(augmentation="d4"))
    sample = make_sample(learner)
    torch.manual_seed(3)
    seen, action = learner._seen(sample)
    assert not torch.equal(action, sample.action)
    torch.testing.assert_close(action[:, :2].square().sum(dim=1), sample.action[:, :2].square().sum(dim=1))
    torch.testing.assert_close(action[:, 2], sample.action[:, 2])
    torch.testing.assert_close(action[:, 3].abs(), sample.action[:, 3].abs())
    assert all(picture.shape == (BATCH, 5, 64, 64) for picture, _ in seen)


def test_frames_keep_colours_and_a_tenth_of_a_millimetre():
    learner = Learner(make_actor())
    batch = training_batch(learner.config, batch=3)
    batch[learner.config.color_key] = (batch[learner.config.color_key] * 255).round() / 255
    packed = learner.codec.pack(batch)
    stacked = {name: torch.from_numpy(np.stack([frame[name] for frame in packed])) for name in packed[0]}
    unpacked = learner.codec.unpack(stacked, torch.device("cpu"))
    # the example's images are larger than the network sees, and are averaged down
    height = torch.nn.functional.interpolate(batch[learner.config.height_key], (76, 76), mode="area")
    torch.testing.assert_close(unpacked[learner.config.height_key], height, rtol=0, atol=1e-4)
    color = torch.nn.functional.interpolate(batch[learner.config.color_key], (76, 76), mode="area")
    torch.testing.assert_close(unpacked[learner.config.color_key], color, rtol=0, atol=0.5 / 255 + 1e-6)
    assert torch.equal(unpacked[keys.STATE], batch[keys.STATE])
    assert stacked[learner.config.color_key].dtype == torch.uint8


def test_saved_and_loaded_it_goes_on_alike(tmp_path):
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
    for one, two in zip(ours.state_dict().values(), other.state_dict().values(), strict=True):
        assert torch.equal(one, two)
