"""Policies in simulators: what they see there, and how well they do in several at once."""

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

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.inputs.scene_input import make_scene_input
from lerobot_policy_symview.policy import SymviewPolicy
from lerobot_policy_symview.processor_pipelines import make_processors
from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_workspace
from lerobot_symview.geometry.units import Unit
from symview_sim.settings import EnvSettings
from symview_sim.simulators import Observation, Observed, Reset, Simulators, Step

EVALUATION_SEED = 1000  # lerobot-eval's first, so that both see the same scenes

Act = Callable[[list[Observation]], NDArray[np.float32]]
"""Maps B observations to B actions in metres and radians, (B, A)."""


class Actor:
    """A policy with its processors, acting on what simulators report.

    Args:
        policy: the policy.
    """

    def __init__(self, policy: SymviewPolicy):
        self.policy = policy
        self.preprocessor, self.postprocessor = make_processors(policy.config, depth_units=metric_depth(policy.config))

    def seen(self, observations: list[Observation]) -> dict[str, Tensor]:
        """Return B observations as the preprocessor leaves them."""
        names = observations[0]
        stacked = {name: torch.from_numpy(np.stack([one[name] for one in observations])) for name in names}
        delivered = {name: _as_delivered(values) for name, values in stacked.items()}
        batch: dict[str, Tensor] = self.preprocessor(delivered)
        return batch

    def __call__(self, observations: list[Observation]) -> NDArray[np.float32]:
        """Return the actions (B, A), in metres and radians."""
        actions: Tensor = self.postprocessor(self.policy.select_action(self.seen(observations)))
        return actions.numpy()


def metric_depth(config: SymviewConfig) -> dict[str, Unit]:
    """Return the units of depth from simulators and from `open_dataset`: metres."""
    depth = [keys.depth(config.camera), keys.depth("top"), config.height_key]
    return {key: "m" for key in depth if key is not None}


def _as_delivered(values: Tensor) -> Tensor:
    """Return images (B, H, W, C) as LeRobot delivers an environment's: (B, C, H, W), colour in [0, 1]."""
    if values.ndim != 4:
        return values
    values = values.permute(0, 3, 1, 2)
    return values.float() / 255 if values.dtype == torch.uint8 else values


def observed(config: SymviewConfig, env: EnvSettings) -> Observed:
    """Return what simulators of `env` must report for a policy to act.

    Raises:
        ValueError: if the state that the policy declares is not that of the simulators.
    """
    config.states.check(len(keys.STATE_NAMES), keys.STATE)
    if any(
        kind in keys.STATE_NAMES and kind != name
        for kind, name in zip(config.state_symmetry, keys.STATE_NAMES, strict=True)
    ):
        raise ValueError(
            f"--policy.state_symmetry={config.state_symmetry} puts entries where a simulator's state has others: "
            f"it is {', '.join(keys.STATE_NAMES)}"
        )
    return Observed(
        env=env,
        names=tuple(make_scene_input(config, parse_workspace(config.workspace)).keys),
        views=tuple(config.views_to_make),
        camera=config.camera,
        workspace=config.workspace,
    )


@dataclass(frozen=True)
class Evaluation:
    """What came of episodes, in the order of their seeds."""

    success: list[bool]
    discounted_return: list[float]

    @property
    def success_rate(self) -> float:
        """Part of the episodes that succeeded."""
        return statistics.fmean(self.success)

    @property
    def mean_return(self) -> float:
        """Of the discounted returns."""
        return statistics.fmean(self.discounted_return)


@dataclass
class _Episode:
    seed: int
    observation: Observation | None = None
    steps: int = 0
    discounted_return: float = 0.0


def evaluate(act: Act, simulators: Simulators, seeds: Sequence[int], discount: float) -> Evaluation:
    """Run an episode from every seed; an episode whose simulator dies is run again."""
    waiting = deque(seeds)
    running: dict[int, _Episode] = {}
    finished: dict[int, tuple[bool, float]] = {}
    with tqdm(total=len(seeds), desc="evaluation", unit="episode", leave=False) as bar:
        while waiting or running:
            _begin(simulators, running, waiting)
            actions = act([episode.observation for episode in running.values() if episode.observation is not None])
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


def _begin(simulators: Simulators, running: dict[int, _Episode], waiting: deque[int]) -> None:
    """Begin an episode in every simulator that has none, as far as seeds are waiting."""
    begun = [index for index in range(len(simulators)) if index not in running][: len(waiting)]
    for index in begun:
        running[index] = _Episode(waiting.popleft())
        simulators.send(index, Reset(running[index].seed))
    for index in begun:
        running[index].observation = simulators.receive(index).observation
