"""Demonstrations of a task by its scripted expert."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_symview import keys
from lerobot_symview.runtime.cli import CommandError
from symview_sim.camera_rig import named_features
from symview_sim.settings import WorldSettings
from symview_sim.table_env import TableEnv

ATTEMPTS = 10
SEEDS_PER_EPISODE, SEEDS_PER_RECORDING = 100, 10**9

EpisodeFrames = dict[str, NDArray[Any]]
"""Values of every feature, by dataset key; the first axis is the frame."""


class Demonstration(NamedTuple):
    """A successful episode."""

    frames: EpisodeFrames
    attempts: int
    """Number of attempts, this one included."""
    style: dict[str, Any]
    """How the expert moved, as JSON values: the fields of a `Style`, or {} for a planner."""


def episode_seed(seed: int, episode: int, attempt: int = 0) -> int:
    """Return the environment's seed of an attempt at an episode of the recording `seed`.

    The seeds are at least 10^9: `lerobot-eval` uses seeds from 1000 upwards.
    """
    return SEEDS_PER_RECORDING * (seed + 1) + SEEDS_PER_EPISODE * episode + attempt


def demonstrate(settings: WorldSettings, seed: int, episode: int, noise: float) -> Demonstration:
    """Return a successful episode. The result depends on the arguments alone.

    Args:
        settings: the environment's; a process makes each environment once.
        seed: the recording's seed.
        episode: index of the episode in the recording.
        noise: standard deviation of the action noise, as a fraction of the largest action.

    Raises:
        CommandError: if ten attempts in a row fail. Without noise, no expert does so within 50 steps.
    """
    env = _environment(settings)
    for attempt in range(ATTEMPTS):
        frames = _attempt(env, episode_seed(seed, episode, attempt), noise)
        if frames is not None:
            stacked = {key: np.stack([frame[key] for frame in frames]) for key in frames[0]}
            return Demonstration(stacked, attempt + 1, env.episode_style)
    raise CommandError(
        f"the expert failed {ATTEMPTS} times in a row: lower --noise or --env.start_jitter, or raise --env.max_steps"
    )


@lru_cache(maxsize=1)
def _environment(settings: WorldSettings) -> TableEnv:
    return settings.make()


def _attempt(env: TableEnv, seed: int, noise: float) -> list[dict[str, NDArray[Any]]] | None:
    """Return an episode's frames, or None if the expert fails."""
    observation, _ = env.reset(seed=seed)
    noise_rng = np.random.default_rng(seed)
    has_noise = [name != "aperture" for name in env.settings.action_names]
    largest = np.where(has_noise, env.action_space.high.astype(np.float64), 0.0)  # type: ignore[attr-defined]
    frames = []
    done = False
    while not done:
        action = env.expert_action()
        before = observation
        disturbance = noise * largest * noise_rng.standard_normal(len(action))
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
