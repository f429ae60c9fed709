"""The training loop of `symview_sacfd`: simulators act while the networks are updated.

Each training step sends one action to every simulator, updates the networks once from the transitions stored before,
and then stores the new transitions. The result does not depend on which of the two is faster, so that runs on a CPU are
bit-identical.
"""

from __future__ import annotations

import math
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
from lerobot_policy_symview.rl.demonstrations import check_scene, observations, ranges, rewards_and_ends
from lerobot_policy_symview.rl.learner import Learner
from lerobot_policy_symview.rl.metrics import MetricsWindow
from lerobot_policy_symview.rl.replay import Replay
from lerobot_policy_symview.rl.rollouts import EVALUATION_SEED, Actor, Evaluation, evaluate, simulator_config
from lerobot_policy_symview.rl.train_config import TrainRlConfig
from symview_sim.simulators import Observation, Outcome, Reset, Simulators, Step

DEMONSTRATIONS = 0  # replay stream of the demonstrations; simulator i has the stream i + 1


@dataclass
class RunningEpisode:
    """The unfinished episode of a simulator; its seed and actions suffice to restore it."""

    seed: int
    actions: list[NDArray[np.float32]] = field(default_factory=list)
    discounted_return: float = 0.0


class Training:
    """A run: simulators, replay buffer and learner, and their progress.

    Args:
        config: the run's configuration.
        dataset: its demonstrations, a `LeRobotDataset`.
    """

    def __init__(self, config: TrainRlConfig, dataset: Any):
        self.config, self._dataset = config, dataset
        check_scene(dataset, config.env, config.policy.camera)
        set_seed(config.seed)
        space: Any = config.env.make().action_space
        policy = deepcopy(config.policy)
        policy.set_dataset_feature_metadata(dataset.meta.features)
        check_scene(dataset, config.env, policy.camera, policy.merged_cameras)  # which the dataset's view may tell
        policy.limit_view()
        self.policy = SymviewSacfdPolicy(policy, ranges(dataset, (space.low, space.high)))
        self.policy.to(policy.device)
        self.actor = Actor(self.policy)
        self.learner = Learner(self.policy, config.steps)
        self.simulator_config = simulator_config(policy, config.env)
        self.replay = self._empty_replay()
        self.simulators = Simulators(self.simulator_config, config.num_simulators)
        self._evaluators: Simulators | None = None
        self.step = 0
        self.episodes = [RunningEpisode(self._seed(i, 0)) for i in range(config.num_simulators)]
        self.episodes_started = [1] * config.num_simulators
        self.window = MetricsWindow()
        self.rng = np.random.default_rng(config.seed)
        self.seconds = dict.fromkeys(("network", "waiting", "simulation", "total"), 0.0)
        self.earlier_cpu_s = 0.0
        """CPU time of the runs that this one resumes, up to their last checkpoints."""
        self._begin_cpu_s = time.process_time()

    def __enter__(self) -> Training:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the simulators' processes."""
        self.simulators.close()
        if self._evaluators is not None:
            self._evaluators.close()

    @property
    def cpu_s(self) -> float:
        """CPU time so far, of simulators and earlier runs too, seconds."""
        evaluators_s = self._evaluators.cpu_seconds() if self._evaluators is not None else 0.0
        own_s = time.process_time() - self._begin_cpu_s
        return self.earlier_cpu_s + own_s + self.simulators.cpu_seconds() + evaluators_s

    def start(self) -> None:
        """Start a new run: store the demonstrations, and start an episode in every simulator."""
        self._request_episodes()
        self._store_demonstrations()
        self._receive_episodes()
        for index, frame in enumerate(self.learner.codec.pack(self._batch)):
            self.replay.start_episode(index + 1, frame)

    def restore_simulators(self) -> None:
        """Bring every simulator to the state of its running episode, by repeating the episode's actions."""
        self._request_episodes()
        self._receive_episodes()

    def joint_step(self) -> None:
        """Step all simulators, and update the networks meanwhile."""
        start = time.perf_counter()
        scaled, actions = self.act()
        for index, action in enumerate(actions):
            self.simulators.send(index, Step(action, self._seed(index, self.episodes_started[index])))
        self.learn()
        learned = time.perf_counter()
        outcomes = [self.simulators.receive(index) for index in range(len(self.episodes))]
        waited = time.perf_counter()
        self._store_transitions(scaled, actions, outcomes)
        self.step += 1
        self.seconds["network"] += learned - start
        self.seconds["waiting"] += waited - learned
        self.seconds["simulation"] += max(outcome.seconds for outcome in outcomes)
        self.seconds["total"] += time.perf_counter() - start

    def act(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Sample an action for every simulator: scaled, and in metres and radians, (simulators, A) each.

        Raises:
            DivergenceError: if an action is not finite.
        """
        self.policy.eval()
        with torch.no_grad(), self.policy.precision():
            scaled, _ = self.policy.sample_action(*self.policy.network_input(self._batch))
        self.policy.check_action(scaled, self._batch)
        return scaled.cpu().numpy(), self._physical(scaled)

    def learn(self) -> None:
        """Update the networks once, if the replay buffer has enough transitions for a batch."""
        if len(self.replay) < self.config.batch_size:
            return
        beta = self.config.replay.beta
        beta += (1 - beta) * self.step / self.config.steps
        sample = self.replay.sample(self.config.batch_size, beta, self.rng)
        td_errors, metrics = self.learner.update(sample)
        self.replay.update_priorities(sample.slots, td_errors)
        self.window.add_update(metrics)

    def evaluate(self) -> Evaluation:
        """Evaluate the policy, without sampling its actions, on scenes that training does not use."""
        if self._evaluators is None:
            self._evaluators = Simulators(self.simulator_config, self.config.num_simulators)
        seeds = range(EVALUATION_SEED, EVALUATION_SEED + self.config.eval_episodes)
        return evaluate(self.actor, self._evaluators, seeds, self.config.policy.discount)

    def pack(self, observation: Observation) -> StoredObservation:
        """Return a simulator's observation as the replay buffer stores it."""
        return self.learner.codec.pack(self.actor.preprocess([observation]))[0]

    def _store_transitions(self, scaled: NDArray, actions: NDArray[np.float32], outcomes: list[Outcome]) -> None:
        """Add the transitions to the replay buffer, and their rewards to the running episodes."""
        self._batch = self.actor.preprocess([_observation_of(outcome) for outcome in outcomes])
        frames = self.learner.codec.pack(self._batch)
        for index, (outcome, frame) in enumerate(zip(outcomes, frames, strict=True)):
            stream, episode = index + 1, self.episodes[index]
            if not outcome.lost:
                done = outcome.last is not None
                terminal = outcome.terminated or (done and self.config.policy.timeouts_are_terminal)
                next_frame = None if terminal else self.pack(outcome.last) if outcome.last is not None else frame
                self.replay.add_transition(stream, scaled[index], outcome.reward, terminal, next_frame)
                episode.discounted_return += self.config.policy.discount ** len(episode.actions) * outcome.reward
                episode.actions.append(actions[index])
                if not done:
                    continue
                self.window.success.append(outcome.success)
                self.window.discounted_return.append(episode.discounted_return)
            else:
                self.window.lost += 1
            self.replay.start_episode(stream, frame)
            self.episodes[index] = RunningEpisode(self._seed(index, self.episodes_started[index]))
            self.episodes_started[index] += 1

    def _request_episodes(self) -> None:
        for index, episode in enumerate(self.episodes):
            self.simulators.send(index, Reset(episode.seed, tuple(episode.actions)))

    def _receive_episodes(self) -> None:
        outcomes = [self.simulators.receive(index) for index in range(len(self.episodes))]
        for index, outcome in enumerate(outcomes):
            if outcome.lost:  # the replaced simulator has reset the episode without repeating its actions
                self.episodes[index] = RunningEpisode(self.episodes[index].seed)
        self._batch = self.actor.preprocess([_observation_of(outcome) for outcome in outcomes])

    def _empty_replay(self) -> Replay:
        config = self.config
        # the last frames of episodes that ran out of time take slots too
        share = math.ceil(min(config.replay.capacity / config.num_simulators, config.steps))
        length = share + share // config.env.episode_steps + 2
        observation, action = next(observations(self._dataset))
        example = self.learner.codec.pack(self.actor.preprocessor(observation))[0]
        lengths = [len(self._dataset), *[length] * config.num_simulators]
        return Replay(config.replay, example, action.shape[1], lengths, config.output_dir / "replay")

    def _store_demonstrations(self) -> None:
        """Add the demonstrations to the replay buffer; actions are clipped to the simulator's limits."""
        reward, ends, succeeds = rewards_and_ends(self._dataset)
        frames: list[StoredObservation] = []
        actions = []
        for observation, action in tqdm(observations(self._dataset), desc="demonstrations", unit="batch", leave=False):
            frames += self.learner.codec.pack(self.actor.preprocessor(observation))
            actions.append(self.policy.scaled(action.to(self.policy.action_center.device)).clamp(-1, 1).cpu().numpy())
        scaled = np.concatenate(actions)
        starts = np.append(True, ends[:-1])
        for i, frame in enumerate(frames):
            if starts[i]:
                self.replay.start_episode(DEMONSTRATIONS, frame)
            if not ends[i] or succeeds[i]:  # the dataset lacks the observation after the last action of a failure
                next_frame = None if ends[i] else frames[i + 1]
                self.replay.add_transition(DEMONSTRATIONS, scaled[i], reward[i], bool(succeeds[i]), next_frame)

    def _physical(self, scaled: Tensor) -> NDArray[np.float32]:
        actions: Tensor = self.actor.postprocessor(self.policy.physical(scaled))
        return actions.numpy()

    def _seed(self, simulator: int, episode: int) -> int:
        """Return the seed of a simulator's n-th episode; seeds of other runs and recordings almost surely differ."""
        return int(np.random.SeedSequence([self.config.seed, simulator, episode]).generate_state(1)[0])


def _observation_of(outcome: Outcome) -> Observation:
    assert outcome.observation is not None
    return outcome.observation
