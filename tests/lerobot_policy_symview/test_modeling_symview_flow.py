"""Chunks by flow matching and by regression: equivariance, several ways to do a task, histories, the action queue."""

import sys

import pytest
import torch
from lerobot.scripts import lerobot_eval
from lerobot.scripts.lerobot_eval import rollout

from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.configuration_symview_flow import SymviewFlowConfig
from lerobot_policy_symview.equivariance import assert_equivariant, equivariance_errors, example_observation
from lerobot_policy_symview.export import export_policy
from lerobot_policy_symview.inputs.history import as_history, latest, stacked
from lerobot_policy_symview.methods import METHODS
from lerobot_policy_symview.model_card import model_card
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.modeling_symview_flow import SymviewFlowPolicy
from lerobot_policy_symview.nn.heads import FlowHead
from lerobot_policy_symview.processor_pipelines import make_processors
from lerobot_policy_symview.symmetry.groups import make_group
from lerobot_policy_symview.symmetry.representations import VectorRepresentation
from lerobot_symview import keys
from tests.helpers.policies import STATS, make_config, take_training_steps
from tests.helpers.training import train as lerobot_train

EQUIVARIANT = [method for method in METHODS if not method.endswith(("_broken", "_relaxed", "_nonequi", "_plucker"))]
POSE = ["x", "y", "z", "yaw", "aperture"]
HORIZON, CHUNK = 6, {"n_obs_steps": 2, "horizon": 6, "n_action_steps": 3, "denoiser_width": 64}
POLICIES = {"flow": (SymviewFlowPolicy, SymviewFlowConfig), "regression": (SymviewBcPolicy, SymviewBcConfig)}


def make_chunk_policy(kind="flow", **options):
    policy_class, config_class = POLICIES[kind]
    torch.manual_seed(0)
    options = CHUNK | {"weight_averaging": 0.0} | options
    return policy_class(make_config(config_class, **options), dataset_stats=STATS)


def chunk_batch(config, samples=3):
    generator = torch.Generator().manual_seed(1)
    history = as_history(example_observation(config, batch=2 * samples), 2)
    actions = 0.05 * torch.rand(samples, HORIZON, 5, generator=generator) - 0.02
    is_pad = torch.zeros(samples, HORIZON, dtype=torch.bool)
    is_pad[0, 4:] = True
    return history | {keys.ACTION: actions, "action_is_pad": is_pad}


def train(policy, steps=3):
    take_training_steps(policy, steps, rate=3e-3, batch=chunk_batch(policy.config))
    return policy


@pytest.mark.parametrize("kind", POLICIES)
@pytest.mark.parametrize("method", [pytest.param(method, marks=pytest.mark.long) for method in EQUIVARIANT])
def test_chunks_are_equivariant_before_and_after_training_and_loading(kind, method, tmp_path):
    policy = make_chunk_policy(kind, method=method)
    assert_equivariant(policy)
    train(policy)
    assert_equivariant(policy)
    policy.save_pretrained(tmp_path)
    loaded = type(policy).from_pretrained(tmp_path)
    assert_equivariant(loaded)
    assert_equivariant(loaded.double(), tolerance=1e-10)


@pytest.mark.parametrize("options", [{"group": "C4"}, {"action_mode": "absolute"}])
def test_other_groups_and_absolute_actions_are_equivariant(options):
    policy = make_chunk_policy(**options)
    train(policy)
    assert_equivariant(policy)


@pytest.mark.long
@pytest.mark.parametrize("method", [method for method in METHODS if method not in EQUIVARIANT])
def test_the_other_methods_train_and_act(method):
    policy = train(make_chunk_policy(method=method))
    chunk = policy.predict_action_chunk(example_observation(policy.config))
    assert chunk.shape == (2, HORIZON, 5)
    assert chunk.isfinite().all()


@pytest.mark.parametrize("options", [{"method": "sideview_nonequi"}, {"encoder": "plain"}])
def test_plain_networks_are_not_equivariant(options):
    policy = make_chunk_policy(**options)
    train(policy, steps=30)
    assert min(equivariance_errors(policy).values()) > 0.05
    with pytest.raises(AssertionError, match="not equivariant"):
        assert_equivariant(policy)


def test_samples_differ_in_their_noise_alone():
    policy = make_chunk_policy()
    train(policy)
    observation = example_observation(policy.config)
    noise = policy.draw_noise(2, torch.Generator().manual_seed(5))
    same = [policy.predict_action_chunk(observation, noise=noise) for _ in range(2)]
    torch.testing.assert_close(*same, rtol=0, atol=0)
    samples = [policy.predict_action_chunk(observation) for _ in range(2)]
    assert (samples[0] - samples[1]).abs().max() > 1e-3


@pytest.mark.parametrize("has_noise", [True, False])
def test_flow_samples_two_ways_and_regression_averages_them(has_noise):
    """Targets at 0.8 and -0.8 along x for the same features."""
    torch.manual_seed(0)
    actions = VectorRepresentation(("x", "y"))
    head = FlowHead(8, actions.matrices(make_group("C1")), horizon=2, width=32, has_noise=has_noise)
    optimizer = torch.optim.Adam(head.parameters(), lr=3e-3)
    features = torch.ones(64, 1, 8)
    for _ in range(400):
        ways = 1.6 * (torch.arange(64) % 2).float() - 0.8
        target = torch.stack([ways, torch.zeros(64)], dim=-1)[:, None].expand(-1, 2, -1)
        loss = head.loss(features, target).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    noise = torch.randn(64, 2, 2) if has_noise else torch.zeros(64, 2, 2)
    with torch.no_grad():
        x = head(features, noise, steps=10)[:, 0, 0]
    if has_noise:
        assert 16 <= int((x > 0).sum()) <= 48
        assert float((x.abs() - 0.8).abs().median()) < 0.2
    else:
        assert float(x.abs().max()) < 0.2


def test_actions_after_the_end_of_an_episode_do_not_count():
    policy = make_chunk_policy("regression").train()
    batch = chunk_batch(policy.config)
    losses = []
    for value in (0.0, 5.0):
        changed = batch[keys.ACTION].clone()
        changed[0, 4:] = value
        torch.manual_seed(0)
        losses.append(policy.forward(batch | {keys.ACTION: changed}, reduction="none")[0])
    torch.testing.assert_close(*losses)
    torch.manual_seed(0)
    counted = policy.forward(
        {name: value for name, value in (batch | {keys.ACTION: changed}).items() if name != "action_is_pad"}, "none"
    )[0]
    assert not torch.allclose(counted[0], losses[0][0])


def test_the_loss_is_the_size_of_the_chunks_at_initialisation():
    """The predicted chunk is zero: the trajectory that stays where it is, with the mean aperture."""
    policy = make_chunk_policy().eval()
    batch = chunk_batch(policy.config, samples=16)
    target = policy.scaled(policy.config.trajectories.relative(batch[keys.ACTION], batch[keys.STATE][:, -1]))
    loss = policy.forward(batch | {"action_is_pad": torch.zeros(16, HORIZON, dtype=torch.bool)})[0]
    torch.testing.assert_close(loss, target.square().mean())


def test_select_action_carries_out_a_chunk_and_then_predicts_the_next():
    policy = make_chunk_policy()
    train(policy)
    frames = [example_observation(policy.config, batch=4) for _ in range(8)]
    for index, frame in enumerate(frames):
        frame[keys.STATE] = frame[keys.STATE] + 0.001 * index
    policy.reset()
    torch.manual_seed(3)
    actions = torch.stack([policy.select_action(frame) for frame in frames])
    torch.manual_seed(3)
    expected = [policy.predict_action_chunk(stacked(frames[:1]))[:, :3]]  # the first observation is repeated
    expected += [policy.predict_action_chunk(stacked(frames[start - 1 : start + 1]))[:, :3] for start in (3, 6)]
    torch.testing.assert_close(actions.transpose(0, 1), torch.cat(expected, dim=1)[:, :8])
    policy.reset()
    torch.manual_seed(3)
    torch.testing.assert_close(policy.select_action(frames[0]), actions[0])


def test_the_views_of_a_history_are_those_of_its_frames():
    policy = make_chunk_policy(method="sideview_equi")
    preprocess, _ = make_processors(policy.config)
    frames = example_observation(policy.config, batch=6)
    alone = preprocess(dict(frames))
    together = preprocess(as_history(frames, 2))
    for name in policy.scene.keys:
        assert together[name].shape[:2] == (3, 2)
        torch.testing.assert_close(together[name], as_history(alone, 2)[name])


def test_more_integration_steps_approach_the_exact_flow():
    policy = make_chunk_policy()
    train(policy, steps=30)
    observation, noise = example_observation(policy.config), policy.draw_noise(2)
    chunks = {}
    for steps in (1, 8, 64):
        policy.config.integration_steps = steps
        chunks[steps] = policy.predict_action_chunk(observation, noise=noise)
    assert (chunks[8] - chunks[64]).abs().max() < (chunks[1] - chunks[64]).abs().max()


@pytest.mark.parametrize("scale", [0.0, 0.5, 1.0])
def test_evaluation_draws_less_noise_than_training(scale):
    policy = make_chunk_policy(noise_scale=scale)
    whole, drawn = (torch.Generator().manual_seed(1) for _ in range(2))
    expected = scale * torch.randn(40, HORIZON, len(policy.config.action_symmetry), generator=whole)
    torch.testing.assert_close(policy.draw_noise(40, drawn), expected)


def test_the_model_card_says_what_it_sees_and_predicts():
    card = str(model_card(make_chunk_policy().config, 1000, "me/data", {}))
    assert "It acts on the last 2 observations of one camera and predicts 6 actions." in card


def test_absolute_actions_need_states_in_the_same_frame():
    with pytest.raises(ValueError, match="needs actions and states in one frame; these states count from the world"):
        make_chunk_policy(action_mode="absolute", state_origin="world", state_names=POSE)


@pytest.mark.parametrize("other", [{"horizon": 5}, {"n_obs_steps": 1}, {"denoiser_width": 32}])
def test_a_checkpoint_of_other_sizes_is_refused_by_the_flag(other, tmp_path):
    make_chunk_policy().save_pretrained(tmp_path)
    with pytest.raises(ValueError, match=r"keep --policy.horizon, --policy.n_obs_steps, .*denoiser_width as trained"):
        SymviewFlowPolicy.from_pretrained(tmp_path, config=make_chunk_policy(**other).config)


def test_observations_of_a_dataset_with_a_history_show_equivariance():
    policy = make_chunk_policy()
    assert_equivariant(policy, observation=as_history(example_observation(policy.config, batch=6), 2))


def test_a_policy_with_a_memory_is_not_exported():
    policy = make_chunk_policy()
    with pytest.raises(ValueError, match=r"only policies of one observation.*symview_flow has n_obs_steps=2 and horiz"):
        export_policy(policy, example_observation(policy.config))


def test_a_history_has_the_features_of_all_its_frames():
    frame = example_observation(make_chunk_policy().config)
    history = stacked([{keys.STATE: frame[keys.STATE]}, frame])
    assert set(history) == {keys.STATE}
    torch.testing.assert_close(latest(history)[keys.STATE], frame[keys.STATE])
    torch.testing.assert_close(latest(frame)[keys.STATE], frame[keys.STATE])


def test_a_policy_that_checks_the_camera_compares_the_present_image(monkeypatch):
    policy = make_chunk_policy()
    policy.config.check_camera = True
    policy.register_buffer("reference_image", torch.zeros(3, 8, 8))
    seen = []
    monkeypatch.setattr("lerobot_policy_symview.policy.check_observation", lambda *arguments: seen.append(arguments[2]))
    frames = [example_observation(policy.config) for _ in range(2)]
    for frame in frames:
        policy.select_action(frame)
    assert len(seen) == 1
    torch.testing.assert_close(seen[0][policy.config.color_key], frames[0][policy.config.color_key])


def test_sampling_in_bfloat16_is_near_that_in_float32():
    policy = make_chunk_policy()
    train(policy)
    observation, noise = example_observation(policy.config), policy.draw_noise(2)
    exact = policy.predict_action_chunk(observation, noise=noise)
    policy.config.dtype = "bfloat16"
    assert (policy.predict_action_chunk(observation, noise=noise) - exact).abs().max() < 0.05 * exact.abs().max()
    assert_equivariant(policy)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["symview_flow", "symview_bc"])
def test_lerobot_trains_resumes_and_evaluates_chunks(kind, with_views, tmp_path, monkeypatch):
    """A new policy, one fine-tuned from its checkpoint, and LeRobot's evaluation, whose seed determines the noise."""
    sizes = ("--policy.width=16", "--policy.crop_size=64")
    chunk = ("--policy.n_obs_steps=2", "--policy.horizon=4", "--policy.n_action_steps=2")
    new = (f"--policy.type={kind}", *sizes, *chunk)
    checkpoint = lerobot_train(monkeypatch, with_views, tmp_path / "policy", policy=new)
    tuned = lerobot_train(monkeypatch, with_views, tmp_path / "tuned", policy=[f"--policy.path={checkpoint}"])
    policy = {"symview_flow": SymviewFlowPolicy, "symview_bc": SymviewBcPolicy}[kind].from_pretrained(tuned)
    assert policy.action_width.shape == (4, 5)
    assert_equivariant(policy)
    rewards = []
    for run in range(2):
        command = f"lerobot-eval --policy.path={tuned} --policy.device=cpu --env.type=symview --env.max_steps=3"
        options = f"--eval.n_episodes=2 --eval.batch_size=2 --seed=5 --output_dir={tmp_path / str(run)}"
        monkeypatch.setattr(sys, "argv", [*command.split(), *options.split()])
        monkeypatch.setattr("lerobot.scripts.lerobot_eval.rollout", recording(rewards, rollout))
        lerobot_eval.main()
    assert len(rewards) == 2
    torch.testing.assert_close(*rewards, rtol=0, atol=0)
    assert rewards[0].shape == (2, 3, 5)


def recording(actions, original):
    """Return LeRobot's rollout, which appends the actions (B, T, A) to a list."""

    def rollout_and_record(*arguments, **options):
        result = original(*arguments, **options)
        actions.append(result["action"])
        return result

    return rollout_and_record
