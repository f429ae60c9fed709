"""The training of `symview_sacfd`: simulators act while the networks are updated.

Every joint step sends one action to each simulator, updates the networks once from what was known before, and takes in
what came of the actions. Nothing depends on which of the two is faster, so that a run can be repeated bit for bit.
"""

from __future__ import annotations

import math
import statistics
import time
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.utils.random_utils import set_seed
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from lerobot_policy_symview.inputs.observation_codec import StoredObservation
from lerobot_policy_symview.modeling_symview_sacfd import SymviewSacfdPolicy
from lerobot_policy_symview.rl.demonstrations import check_scene, observations, outcomes, ranges
from lerobot_policy_symview.rl.learner import Learner
from lerobot_policy_symview.rl.replay import Replay
from lerobot_policy_symview.rl.rollouts import EVALUATION_SEED, Actor, Evaluation, evaluate, observed
from lerobot_policy_symview.rl.train_config import TrainRlConfig
from symview_sim.simulators import Observation, Outcome, Reset, Simulators, Step

EXPERT = 0  # the stream of the demonstrations; simulator i has the stream i + 1


@dataclass
class Episode:
    """The episode that a simulator is in, which its seed and the actions taken determine."""

    seed: int
    actions: list[NDArray[np.float32]] = field(default_factory=list)
    discounted_return: float = 0.0


@dataclass
class Interval:
    """What happened since a row of the log."""

    updates: int = 0
    sums: dict[str, Any] = field(default_factory=dict)
    success: list[bool] = field(default_factory=list)
    discounted_return: list[float] = field(default_factory=list)
    lost: int = 0

    def add(self, measures: dict[str, Tensor]) -> None:
        """Add an update's."""
        self.updates += 1
        for name, value in measures.items():
            self.sums[name] = self.sums.get(name, 0.0) + value

    def row(self, names: tuple[str, ...]) -> dict[str, float]:
        """Return means, `nan` where there is nothing to average; reading them waits for a GPU."""
        updates = {name: float(self.sums[name]) / self.updates if self.updates else math.nan for name in names}
        return {
            "episodes": len(self.success),
            "success": statistics.fmean(self.success) if self.success else math.nan,
            "return": statistics.fmean(self.discounted_return) if self.success else math.nan,
            "lost_episodes": self.lost,
            **updates,
        }

    def plain(self) -> dict[str, Any]:
        """Return what a checkpoint's JSON holds; Python's floats survive it to the last bit."""
        return vars(self) | {"sums": {name: float(value) for name, value in self.sums.items()}}


class Training:
    """A run: simulators, replay and learner, and how far they have come.

    Args:
        config: what to train.
        dataset: its demonstrations, a `LeRobotDataset`.
    """

    def __init__(self, config: TrainRlConfig, dataset: Any):
        self.config, self._dataset = config, dataset
        check_scene(dataset, config.env, config.policy.camera)
        set_seed(config.seed)
        space: Any = config.env.make().action_space
        policy = deepcopy(config.policy)
        policy.set_dataset_feature_metadata(dataset.meta.features)
        policy.limit_view()
        self.policy = SymviewSacfdPolicy(policy, ranges(dataset, (space.low, space.high)))
        self.policy.to(policy.device)
        self.actor = Actor(self.policy)
        self.learner = Learner(self.policy)
        self.observed = observed(policy, config.env)
        self.replay = self._empty_replay()
        self._simulators = Simulators(self.observed, config.num_simulators)
        self._evaluators: Simulators | None = None
        self.step = 0
        self.episodes = [Episode(self._seed(i, 0)) for i in range(config.num_simulators)]
        self.episodes_begun = [1] * config.num_simulators
        self.interval = Interval()
        self.rng = np.random.default_rng(config.seed)
        self.seconds = dict.fromkeys(("network", "waiting", "simulation", "total"), 0.0)

    def __enter__(self) -> Training:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the simulators."""
        self._simulators.close()
        if self._evaluators is not None:
            self._evaluators.close()

    def begin(self) -> None:
        """Fill the replay's beginning with the demonstrations, and begin an episode in every simulator."""
        self._request_episodes()
        self._remember_demonstrations()
        self._receive_episodes()
        for index, frame in enumerate(self.learner.codec.pack(self._batch)):
            self.replay.begin(index + 1, frame)

    def go_on(self) -> None:
        """Bring every simulator to where its episode is."""
        self._request_episodes()
        self._receive_episodes()

    def joint_step(self) -> None:
        """Act in every simulator, and update the networks meanwhile."""
        start = time.perf_counter()
        scaled, actions = self.act()
        for index, action in enumerate(actions):
            self._simulators.send(index, Step(action, self._seed(index, self.episodes_begun[index])))
        self.learn()
        learned = time.perf_counter()
        received = [self._simulators.receive(index) for index in range(len(self.episodes))]
        waited = time.perf_counter()
        self._take_in(scaled, actions, received)
        self.step += 1
        self.seconds["network"] += learned - start
        self.seconds["waiting"] += waited - learned
        self.seconds["simulation"] += max(outcome.seconds for outcome in received)
        self.seconds["total"] += time.perf_counter() - start

    def act(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Draw an action for every simulator: scaled and in metres and radians, (simulators, A) each."""
        self.policy.eval()
        with torch.no_grad(), self.policy.precision():
            scaled, _ = self.policy.draw(*self.policy.network_input(self._batch))
        return scaled.cpu().numpy(), self._physical(scaled)

    def learn(self) -> None:
        """Update the networks once, if enough is remembered."""
        if len(self.replay) < self.config.batch_size:
            return
        beta = self.config.replay.beta
        beta += (1 - beta) * self.step / self.config.steps
        sample = self.replay.sample(self.config.batch_size, beta, self.rng)
        errors, measures = self.learner.update(sample)
        self.replay.prioritise(sample.slots, errors)
        self.interval.add(measures)

    def evaluate(self) -> Evaluation:
        """Run the policy, without chance, on scenes that training does not see."""
        if self._evaluators is None:
            self._evaluators = Simulators(self.observed, self.config.num_simulators)
        seeds = range(EVALUATION_SEED, EVALUATION_SEED + self.config.eval_episodes)
        return evaluate(self.actor, self._evaluators, seeds, self.config.policy.discount)

    def _take_in(self, scaled: NDArray, actions: NDArray[np.float32], received: list[Outcome]) -> None:
        """Remember what came of the actions."""
        self._batch = self.actor.seen([_acted_upon(outcome) for outcome in received])
        frames = self.learner.codec.pack(self._batch)
        for index, (outcome, frame) in enumerate(zip(received, frames, strict=True)):
            stream, episode = index + 1, self.episodes[index]
            if not outcome.lost:
                ended = outcome.last is not None
                terminal = outcome.terminated or (ended and self.config.policy.timeouts_are_terminal)
                following = None if terminal else self._pack(outcome.last) if ended else frame
                self.replay.add(stream, scaled[index], outcome.reward, terminal, following)
                episode.discounted_return += self.config.policy.discount ** len(episode.actions) * outcome.reward
                episode.actions.append(actions[index])
                if not ended:
                    continue
                self.interval.success.append(outcome.success)
                self.interval.discounted_return.append(episode.discounted_return)
            else:
                self.interval.lost += 1
            self.replay.begin(stream, frame)
            self.episodes[index] = Episode(self._seed(index, self.episodes_begun[index]))
            self.episodes_begun[index] += 1

    def _request_episodes(self) -> None:
        for index, episode in enumerate(self.episodes):
            self._simulators.send(index, Reset(episode.seed, tuple(episode.actions)))

    def _receive_episodes(self) -> None:
        received = [self._simulators.receive(index) for index in range(len(self.episodes))]
        for index, outcome in enumerate(received):
            if outcome.lost:  # begun anew, without the actions
                self.episodes[index] = Episode(self.episodes[index].seed)
        self._batch = self.actor.seen([_acted_upon(outcome) for outcome in received])

    def _empty_replay(self) -> Replay:
        config = self.config
        # the last frames of episodes that ran out of time take slots too
        share = math.ceil(min(config.replay.capacity / config.num_simulators, config.steps))
        length = share + share // config.env.max_steps + 2
        observation, action = next(observations(self._dataset))
        example = self.learner.codec.pack(self.actor.preprocessor(observation))[0]
        lengths = [len(self._dataset), *[length] * config.num_simulators]
        return Replay(config.replay, example, action.shape[1], lengths, config.output_dir / "replay")

    def _remember_demonstrations(self) -> None:
        """Add what the expert did; actions beyond the simulator's limits are cut to them."""
        reward, ends, succeeds = outcomes(self._dataset)
        frames: list[StoredObservation] = []
        actions = []
        for observation, action in tqdm(observations(self._dataset), desc="demonstrations", unit="batch", leave=False):
            frames += self.learner.codec.pack(self.actor.preprocessor(observation))
            actions.append(self.policy.scaled(action.to(self.policy.action_center.device)).clamp(-1, 1).cpu().numpy())
        scaled = np.concatenate(actions)
        begins = np.append(True, ends[:-1])
        for i, frame in enumerate(frames):
            if begins[i]:
                self.replay.begin(EXPERT, frame)
            if not ends[i] or succeeds[i]:  # what followed the last frame of a failure is not known
                self.replay.add(EXPERT, scaled[i], reward[i], bool(succeeds[i]), None if ends[i] else frames[i + 1])

    def _pack(self, seen: Observation | None) -> StoredObservation:
        assert seen is not None
        return self.learner.codec.pack(self.actor.seen([seen]))[0]

    def _physical(self, scaled: Tensor) -> NDArray[np.float32]:
        actions: Tensor = self.actor.postprocessor(self.policy.physical(scaled))
        return actions.numpy()

    def _seed(self, simulator: int, episode: int) -> int:
        """Return the seed of a simulator's n-th episode, as good as never one of another training or recording."""
        return int(np.random.SeedSequence([self.config.seed, simulator, episode]).generate_state(1)[0])


def _acted_upon(outcome: Outcome) -> Observation:
    assert outcome.observation is not None
    return outcome.observation
