"""How well a policy does, in several simulators at once."""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from symview_sim.simulators import Observation, Reset, Simulators, Step

Act = Callable[[list[Observation]], NDArray[np.float32]]
"""Maps B observations to B actions in metres and radians, (B, A)."""


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
