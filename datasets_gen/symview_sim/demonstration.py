"""An expert's demonstration of a task, recorded frame by frame."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_symview import keys
from lerobot_symview.runtime.cli import CommandError
from symview_sim.env import SymviewEnv, named_features
from symview_sim.settings import EnvSettings

ATTEMPTS = 10
SEEDS_PER_EPISODE, SEEDS_PER_RECORDING = 100, 10**9

# Feature -> its values in every frame, time first.
EpisodeFrames = dict[str, NDArray[Any]]


def episode_seed(seed: int, episode: int, attempt: int = 0) -> int:
    """Return the environment's seed of an episode of the recording `seed`; `lerobot-eval` seeds from 1000 upwards."""
    return SEEDS_PER_RECORDING * (seed + 1) + SEEDS_PER_EPISODE * episode + attempt


def demonstrate(settings: EnvSettings, seed: int, episode: int, noise: float) -> tuple[EpisodeFrames, int]:
    """Return a successful episode and the attempts it took; it depends on the arguments alone.

    Args:
        settings: the environment, which a process makes once.
        seed: the recording's.
        episode: its number in the recording.
        noise: standard deviation of a disturbance of every motion, as a fraction of the largest one.

    Raises:
        CommandError: when ten attempts in a row fail, which an undisturbed expert's never do in 50 steps.
    """
    env = _environment(settings)
    for attempt in range(ATTEMPTS):
        frames = _attempt(env, episode_seed(seed, episode, attempt), noise)
        if frames is not None:
            return {key: np.stack([frame[key] for frame in frames]) for key in frames[0]}, attempt + 1
    raise CommandError(
        f"the expert failed {ATTEMPTS} times in a row: lower --noise or --env.start_jitter, or raise --env.max_steps"
    )


@lru_cache(maxsize=1)
def _environment(settings: EnvSettings) -> SymviewEnv:
    return settings.make()


def _attempt(env: SymviewEnv, seed: int, noise: float) -> list[dict[str, NDArray[Any]]] | None:
    """Return an episode's frames if the expert succeeds."""
    observation, _ = env.reset(seed=seed)
    disturbances = np.random.default_rng(seed)
    largest = np.append(env.action_space.high[:4], 0.0)  # type: ignore[attr-defined]  # the aperture is left alone
    frames = []
    done = False
    while not done:
        action = env.expert_action()
        before = observation
        disturbance = noise * largest * disturbances.standard_normal(len(action))
        observation, reward, terminated, truncated, info = env.step(action + disturbance)
        done = terminated or truncated
        outcome = {
            keys.ACTION: action,
            "next.reward": np.array([reward], dtype=np.float32),
            "next.done": np.array([done]),
            "next.success": np.array([info["is_success"]]),
        }
        frames.append(named_features(before) | outcome)
    return frames if info["is_success"] else None
