"""Evaluation episodes in simulators: in lockstep for policies that remember, else independent of each other."""

import numpy as np
import pytest
import torch

from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.configuration_symview_flow import SymviewFlowConfig
from lerobot_policy_symview.equivariance import example_observation
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.modeling_symview_flow import SymviewFlowPolicy
from lerobot_policy_symview.rl.rollouts import Actor, evaluate
from lerobot_symview import keys
from symview_sim.simulators import Outcome, Reset
from tests.helpers.policies import STATS, make_config

LENGTHS = {0: 3, 1: 7, 2: 1, 3: 5, 4: 4}
CHUNKS = {"n_obs_steps": 2, "horizon": 4, "n_action_steps": 3, "denoiser_width": 64, "weight_averaging": 0.0}


def observe(seed, step):
    return {keys.STATE: np.array([seed, step], dtype=np.float32)}


class ScriptedSimulators:
    """Simulators whose episodes have the lengths `LENGTHS`; even seeds succeed.

    Args:
        count: number of simulators.
        observe: returns the observation of a seed's episode after a number of steps.
        dies: seeds whose simulator dies once, at the second step.
    """

    def __init__(self, count, observe=observe, dies=()):
        self.count, self.observe, self.dies = count, observe, set(dies)
        self.episodes, self.outcomes, self.actions = {}, {}, {}
        self.started = []

    def __len__(self):
        return self.count

    def send(self, index, command):
        if isinstance(command, Reset):
            self.started.append(command.seed)
            self.episodes[index], self.actions[command.seed] = (command.seed, 0), []
            self.outcomes[index] = Outcome(self.observe(command.seed, 0))
            return
        (seed, step), step_after = self.episodes[index], self.episodes[index][1] + 1
        self.episodes[index] = (seed, step_after)
        if seed in self.dies and step == 1:
            self.dies.remove(seed)
            self.outcomes[index] = Outcome(self.observe(0, 0), lost=True)
            return
        self.actions[seed].append(np.array(command.action))
        seen, is_last = self.observe(seed, step_after), step_after == LENGTHS[seed]
        success = is_last and seed % 2 == 0
        self.outcomes[index] = Outcome(
            None if is_last else seen, seen if is_last else None, float(success), success=success
        )

    def receive(self, index):
        return self.outcomes[index]


class RememberingActor(Actor):
    """Its action is the sum of all states of the row since the start of the episode."""

    remembers = True

    def __init__(self):
        self.calls, self.sums = 0, 0.0

    def start_episodes(self, seed):
        self.sums = 0.0
        torch.manual_seed(seed)

    def __call__(self, observations):
        self.calls += 1
        self.sums = self.sums + np.stack([observation[keys.STATE] for observation in observations])
        return self.sums


class RandomActor(RememberingActor):
    """Its actions are random."""

    def __call__(self, observations):
        return torch.rand(len(observations), 2).numpy()


def run(actor, count, **options):
    simulators = ScriptedSimulators(count, **options)
    return evaluate(actor, simulators, list(LENGTHS), 0.9), simulators


@pytest.mark.parametrize("count", [2, 3, 8])
def test_lockstep_gives_every_episode_the_actions_that_it_gets_alone(count):
    alone, one = run(RememberingActor(), 1)
    together, several = run(RememberingActor(), count)
    assert together == alone
    assert {seed: len(actions) for seed, actions in several.actions.items()} == LENGTHS
    for seed, actions in one.actions.items():
        assert np.array_equal(several.actions[seed], actions)
    assert alone.success == [True, False, True, False, True]
    assert alone.discounted_return == pytest.approx([0.9**2, 0, 1, 0, 0.9**3])


def test_a_policy_without_memory_does_not_wait():
    calls = []

    def act(observations):
        calls.append(len(observations))
        return np.stack([observation[keys.STATE] for observation in observations])

    actor = RememberingActor()
    (independent, _), (lockstep, _) = run(act, 2), run(actor, 2)
    assert independent == lockstep
    assert sum(calls) == sum(LENGTHS.values())
    assert actor.calls == 7 + 5 + 4
    assert len(calls) < actor.calls


@pytest.mark.parametrize("actor", [RememberingActor(), lambda seen: np.stack([one[keys.STATE] for one in seen])])
def test_an_episode_whose_simulator_dies_is_run_again(actor):
    expected, whole = run(actor, 2)
    repeated, simulators = run(actor, 2, dies=[1])
    assert repeated == expected
    assert sorted(simulators.started) == [0, 1, 1, 2, 3, 4]
    for seed, actions in whole.actions.items():
        assert np.array_equal(simulators.actions[seed], actions)


def test_random_actions_follow_from_the_seeds_and_leave_the_random_numbers_of_a_training():
    torch.manual_seed(7)
    before = torch.get_rng_state()
    first, second = run(RandomActor(), 2)[1], run(RandomActor(), 2)[1]
    assert torch.equal(torch.get_rng_state(), before)
    for seed, actions in first.actions.items():
        assert np.array_equal(second.actions[seed], actions)
    assert not np.array_equal(first.actions[0][0], first.actions[1][0])


@pytest.mark.parametrize(
    ("policy_class", "config_class", "options", "remembers"),
    [
        (SymviewBcPolicy, SymviewBcConfig, {}, False),
        (SymviewBcPolicy, SymviewBcConfig, CHUNKS, True),
        (SymviewBcPolicy, SymviewBcConfig, CHUNKS | {"horizon": 1, "n_action_steps": 1}, True),
        (SymviewFlowPolicy, SymviewFlowConfig, CHUNKS, True),
        (SymviewFlowPolicy, SymviewFlowConfig, {"n_obs_steps": 1, "horizon": 1, "n_action_steps": 1}, True),
    ],
)
def test_policies_with_a_history_chunks_or_noise_remember(policy_class, config_class, options, remembers):
    assert Actor(policy_class(make_config(config_class, **options), STATS)).remembers == remembers


def test_a_policy_of_chunks_acts_in_lockstep_as_alone():
    torch.manual_seed(0)
    policy = SymviewBcPolicy(make_config(SymviewBcConfig, **CHUNKS), STATS)
    for parameter in policy.network.head.parameters():  # an untrained head returns zeros
        torch.nn.init.normal_(parameter, std=0.1)
    frames = example_observation(policy.config, batch=max(LENGTHS.values()) + 1)

    def shown(seed, step):
        named = {name: values[step].numpy() for name, values in frames.items()}
        images = {name: value.transpose(1, 2, 0) for name, value in named.items() if value.ndim == 3}
        return named | images | {keys.STATE: named[keys.STATE] + np.float32(0.01 * seed)}

    _, one = run(Actor(policy), 1, observe=shown)
    _, several = run(Actor(policy), 3, observe=shown)
    for seed, actions in one.actions.items():
        assert np.allclose(several.actions[seed], actions, atol=1e-6)
    assert not np.allclose(one.actions[3][0], one.actions[3][3])  # the second chunk was predicted anew
