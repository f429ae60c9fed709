"""Rollouts of policies in simulators, and their evaluation in several simulators at once."""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from lerobot_policy_symview.chunks import ChunkPolicy
from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.configuration_chunks import wrist_key
from lerobot_policy_symview.inputs.scene_input import make_scene_input
from lerobot_policy_symview.policy import SymviewPolicy
from lerobot_policy_symview.processor_pipelines import make_processors
from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_workspace
from lerobot_symview.geometry.units import METRES
from symview_sim.settings import WorldSettings
from symview_sim.simulators import Observation, Outcome, Reset, SimulatorConfig, Simulators, Step

EVALUATION_SEED = 1000  # first seed of lerobot-eval, so that both evaluate on the same scenes

SelectActions = Callable[[list[Observation]], NDArray[np.float32]]
"""Maps B observations to actions (B, A) in metres and radians."""


class Actor:
    """A policy with its processors, which acts on the observations of simulators.

    Args:
        policy: the policy.
    """

    def __init__(self, policy: SymviewPolicy):
        self.policy: Any = policy
        self.scene = policy.scene
        self.preprocessor, self.postprocessor = make_processors(policy.config, depth_units=metric_depth(policy.config))

    @property
    def remembers(self) -> bool:
        """Whether an action depends on earlier observations of the episode, was planned with them, or is drawn."""
        if not isinstance(self.policy, ChunkPolicy):
            return False
        return self.policy.has_noise or not self.policy.config.is_reactive

    def copy(self) -> Actor:
        """Return an actor with a copy of the policy as it is now."""
        return Actor(deepcopy(self.policy))

    def see(self, observation: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return observations (B, ...) with all that `scene` reads: what preprocessing does with each frame alone."""
        seen: dict[str, Tensor] = self.preprocessor(observation)
        return seen

    def finish(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return what the policy takes, for observations that `see` returned, and with a history (B, T, ...)."""
        return batch

    def start_episodes(self, seed: int) -> None:
        """Forget the last episodes. What the policy draws at random follows from the seed; it is PyTorch's seed."""
        self.policy.eval()  # not all of LeRobot's policies do this themselves
        self.policy.reset()
        torch.manual_seed(seed)

    def preprocess(self, observations: list[Observation]) -> dict[str, Tensor]:
        """Return B observations as a preprocessed batch."""
        names = observations[0]
        stacked = {
            name: torch.from_numpy(np.stack([observation[name] for observation in observations])) for name in names
        }
        return self.finish(self.see({name: _to_lerobot_layout(values) for name, values in stacked.items()}))

    def __call__(self, observations: list[Observation]) -> NDArray[np.float32]:
        """Return the evaluation actions (B, A), in metres and radians."""
        actions: Tensor = self.postprocessor(self.policy.select_action(self.preprocess(observations)))
        return actions.numpy()


def _to_lerobot_layout(values: Tensor) -> Tensor:
    """Return images (B, H, W, C) in LeRobot's layout for environments: (B, C, H, W), RGB in [0, 1]."""
    if values.ndim != 4:
        return values
    values = values.permute(0, 3, 1, 2)
    return values.float() / 255 if values.dtype == torch.uint8 else values


def metric_depth(config: SymviewConfig) -> dict[str, float]:
    """Return the unit of depth from simulators and from `open_dataset`: metres."""
    depth = [keys.depth(config.camera), keys.depth("top"), config.height_key]
    return {key: METRES for key in depth if key is not None}


def simulator_config(config: SymviewConfig, env: WorldSettings) -> SimulatorConfig:
    """Return the configuration of simulators of `env` whose observations have the features that a policy needs.

    Raises:
        ValueError: if `config.state_symmetry` does not fit the simulators' state, or they have no camera on the gripper
            and the policy needs it.
    """
    names, wrist = env.state_names, wrist_key(config)
    if wrist is not None and not (wrist == keys.rgb(keys.WRIST) and env.has_wrist_camera):
        raise ValueError(f"the policy needs {wrist}: --env.wrist_camera=true simulates {keys.rgb(keys.WRIST)}")
    config.states.check(len(names), keys.STATE)
    if any(kind in names and kind != name for kind, name in zip(config.state_symmetry, names, strict=True)):
        raise ValueError(
            f"--policy.state_symmetry={config.state_symmetry} does not fit the simulators' state, which is "
            f"[{', '.join(names)}]"
        )
    scene = make_scene_input(config, parse_workspace(config.workspace))
    lenses = [keys.distortion(spec.name) for spec in env.all_cameras if spec.states_lens]
    return SimulatorConfig(
        env=env,
        names=(*scene.keys, *(key for key in scene.optional_keys if key in lenses), *filter(None, [wrist])),
        views=tuple(config.views_to_make),
        camera=config.camera,
        workspace=config.workspace,
    )


@dataclass(frozen=True)
class Evaluation:
    """Results of evaluation episodes, in the order of their seeds."""

    success: list[bool]
    discounted_return: list[float]

    @property
    def success_rate(self) -> float:
        """Fraction of the episodes that succeeded."""
        return statistics.fmean(self.success)

    @property
    def mean_return(self) -> float:
        """Mean discounted return."""
        return statistics.fmean(self.discounted_return)


@dataclass
class _Episode:
    seed: int
    observation: Observation
    steps: int = 0
    discounted_return: float = 0.0


def evaluate(
    select_actions: SelectActions, simulators: Simulators, seeds: Sequence[int], discount: float
) -> Evaluation:
    """Run one episode per seed; an episode whose simulator dies is run again.

    An actor that remembers runs its episodes in lockstep: as many as there are simulators start together, and the next
    ones when all of these have ended. What it draws at random follows from the seeds and the number of simulators;
    PyTorch's random numbers are those of all threads, so no other thread may draw any meanwhile.

    Args:
        select_actions: the policy, such as an `Actor`.
        simulators: simulators to run in, as many episodes at a time.
        seeds: seeds of the episodes.
        discount: discount factor of the returns.
    """
    with tqdm(total=len(seeds), desc="evaluation", unit="episode", leave=False) as bar:
        episodes = _Episodes(simulators, seeds, discount, bar)
        if isinstance(select_actions, Actor) and select_actions.remembers:
            _run_in_lockstep(select_actions, episodes)
        else:
            _run_independently(select_actions, episodes)
    success, discounted_return = zip(*(episodes.finished[seed] for seed in seeds), strict=True)
    return Evaluation(list(success), list(discounted_return))


def _run_independently(select_actions: SelectActions, episodes: _Episodes) -> None:
    """Start an episode wherever one has ended."""
    while episodes.waiting or episodes.running:
        episodes.start()
        actions = select_actions([episode.observation for episode in episodes.running.values()])
        episodes.step(dict(zip(episodes.running, actions, strict=True)))


def _run_in_lockstep(actor: Actor, episodes: _Episodes) -> None:
    """Start episodes together. Those that have ended keep their last observation: the policy knows them by row."""
    with torch.random.fork_rng():
        while episodes.waiting:
            episodes.start()
            rows = dict(episodes.running)
            actor.start_episodes(next(iter(rows.values())).seed)
            while episodes.running:
                actions = actor([episode.observation for episode in rows.values()])
                chosen = zip(rows, actions, strict=True)
                episodes.step({index: action for index, action in chosen if index in episodes.running})


class _Episodes:
    """Evaluation episodes: those that wait, those that run, by their simulator, and the results of the others.

    Args:
        simulators: simulators to run in.
        seeds: seeds of the episodes.
        discount: discount factor of the returns.
        bar: counts finished episodes.
    """

    def __init__(self, simulators: Simulators, seeds: Sequence[int], discount: float, bar: tqdm[Any]):
        self._simulators, self._discount, self._bar = simulators, discount, bar
        self.waiting = deque(seeds)
        self.running: dict[int, _Episode] = {}
        self.finished: dict[int, tuple[bool, float]] = {}
        """Seed -> success and discounted return."""

    def start(self) -> None:
        """Start an episode in every idle simulator while seeds are waiting."""
        idle = [index for index in range(len(self._simulators)) if index not in self.running]
        started = {index: self.waiting.popleft() for index in idle[: len(self.waiting)]}
        for index, seed in started.items():
            self._simulators.send(index, Reset(seed))
        for index, seed in started.items():
            self.running[index] = _Episode(seed, self._observed(self._simulators.receive(index)))

    def step(self, actions: dict[int, NDArray[np.float32]]) -> None:
        """Carry out an action in each simulator that runs an episode."""
        for index, action in actions.items():
            self._simulators.send(index, Step(action, next_seed=None))
        for index in actions:
            outcome, episode = self._simulators.receive(index), self.running[index]
            episode.discounted_return += self._discount**episode.steps * outcome.reward
            episode.steps += 1
            episode.observation = self._observed(outcome)
            if outcome.lost:
                self.waiting.appendleft(self.running.pop(index).seed)
            elif outcome.last is not None:
                del self.running[index]
                self.finished[episode.seed] = (outcome.success, episode.discounted_return)
                self._bar.update()

    @staticmethod
    def _observed(outcome: Outcome) -> Observation:
        """Return the present observation, or the last one of an episode that has ended."""
        observed = outcome.observation if outcome.last is None else outcome.last
        assert observed is not None  # only an episode that has ended has none
        return observed
