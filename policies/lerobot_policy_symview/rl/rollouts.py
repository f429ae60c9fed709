"""Rollouts of policies in simulators, and their evaluation in several simulators at once."""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from lerobot_policy_symview.chunks import ChunkPolicy
from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.inputs.scene_input import make_scene_input
from lerobot_policy_symview.policy import SymviewPolicy
from lerobot_policy_symview.processor_pipelines import make_processors
from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_workspace
from lerobot_symview.geometry.units import METRES
from symview_sim.settings import WorldSettings
from symview_sim.simulators import Observation, Reset, SimulatorConfig, Simulators, Step

EVALUATION_SEED = 1000  # first seed of lerobot-eval, so that both evaluate on the same scenes

SelectActions = Callable[[list[Observation]], NDArray[np.float32]]
"""Maps B observations to actions (B, A) in metres and radians."""


class Actor:
    """A policy with its processors, which acts on the observations of simulators.

    Args:
        policy: the policy; its episodes start and end at different times, so it must not have a memory.

    Raises:
        ValueError: if the policy has a memory.
    """

    def __init__(self, policy: SymviewPolicy):
        if isinstance(policy, ChunkPolicy) and not policy.config.is_reactive:
            raise ValueError(
                f"{policy.name} with --policy.n_obs_steps={policy.config.n_obs_steps} and "
                f"--policy.horizon={policy.config.horizon} remembers observations and actions: use lerobot-eval"
            )
        self.policy = policy
        self.preprocessor, self.postprocessor = make_processors(policy.config, depth_units=metric_depth(policy.config))

    def preprocess(self, observations: list[Observation]) -> dict[str, Tensor]:
        """Return B observations as a preprocessed batch."""
        names = observations[0]
        stacked = {
            name: torch.from_numpy(np.stack([observation[name] for observation in observations])) for name in names
        }
        batch: dict[str, Tensor] = self.preprocessor(
            {name: _to_lerobot_layout(values) for name, values in stacked.items()}
        )
        return batch

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
        ValueError: if `config.state_symmetry` does not fit the simulators' state.
    """
    names = env.state_names
    config.states.check(len(names), keys.STATE)
    if any(kind in names and kind != name for kind, name in zip(config.state_symmetry, names, strict=True)):
        raise ValueError(
            f"--policy.state_symmetry={config.state_symmetry} does not fit the simulators' state, which is "
            f"[{', '.join(names)}]"
        )
    return SimulatorConfig(
        env=env,
        names=tuple(make_scene_input(config, parse_workspace(config.workspace)).keys),
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
class _EvaluationEpisode:
    seed: int
    observation: Observation | None = None
    steps: int = 0
    discounted_return: float = 0.0


def evaluate(
    select_actions: SelectActions, simulators: Simulators, seeds: Sequence[int], discount: float
) -> Evaluation:
    """Run one episode per seed; an episode whose simulator dies is run again.

    Args:
        select_actions: the policy, such as an `Actor`.
        simulators: simulators to run in, as many episodes at a time.
        seeds: seeds of the episodes.
        discount: discount factor of the returns.
    """
    waiting = deque(seeds)
    running: dict[int, _EvaluationEpisode] = {}
    finished: dict[int, tuple[bool, float]] = {}
    with tqdm(total=len(seeds), desc="evaluation", unit="episode", leave=False) as bar:
        while waiting or running:
            _start_episodes(simulators, running, waiting)
            actions = select_actions(
                [episode.observation for episode in running.values() if episode.observation is not None]
            )
            for index, action in zip(running, actions, strict=True):
                simulators.send(index, Step(action, next_seed=None))
            for index, episode in list(running.items()):
                outcome = simulators.receive(index)
                episode.discounted_return += discount**episode.steps * outcome.reward
                episode.steps += 1
                episode.observation = outcome.observation
                if outcome.lost:
                    waiting.appendleft(running.pop(index).seed)
                elif outcome.last is not None:
                    del running[index]
                    finished[episode.seed] = (outcome.success, episode.discounted_return)
                    bar.update()
    success, discounted_return = zip(*(finished[seed] for seed in seeds), strict=True)
    return Evaluation(list(success), list(discounted_return))


def _start_episodes(simulators: Simulators, running: dict[int, _EvaluationEpisode], waiting: deque[int]) -> None:
    """Start an episode in every idle simulator while seeds are waiting."""
    started = [index for index in range(len(simulators)) if index not in running][: len(waiting)]
    for index in started:
        running[index] = _EvaluationEpisode(waiting.popleft())
        simulators.send(index, Reset(running[index].seed))
    for index in started:
        running[index].observation = simulators.receive(index).observation
