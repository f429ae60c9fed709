"""`symview-generate`: expert demonstrations of a task as a LeRobot dataset."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from lerobot_symview import keys
from lerobot_symview.cli import CommandError, DatasetTarget, run_command
from lerobot_symview.features import Features, camera_features
from lerobot_symview.staging import staged
from symview_sim.settings import EnvSettings

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-generate --dataset.repo_id=me/picking --env.task=block_picking --num_episodes=50
  symview-generate --dataset.repo_id=me/low --dataset.root=data/low --env.camera.elevation_deg=20 --env.oracle=false"""

# lerobot-eval seeds its episodes from 1000 upwards: demonstrations are drawn from elsewhere.
FIRST_SEED = 1_000_000
MAX_FAILURE_RATE = 0.2

Episode = list[dict[str, Any]]


@dataclass(frozen=True)
class RecordedEnv(EnvSettings):
    """The environment of a recording, which shows the oracle too."""

    oracle: bool = True
    """Also record `top`, which looks straight down and does not see the arm."""


@dataclass(frozen=True)
class GenerateConfig:
    """Let a task's expert demonstrate it and record what the cameras see."""

    dataset: DatasetTarget
    """Where the dataset goes."""
    env: RecordedEnv = field(default_factory=RecordedEnv)
    """What is demonstrated, and which cameras see it."""
    num_episodes: int = 50
    """How many successful demonstrations."""
    seed: int = 0
    """Chooses the scenes: episode i starts from seed 1,000,000 (seed + 1) + i."""
    noise: float = 0.0
    """Standard deviation of a disturbance of every motion, as a fraction of the largest one (0.2: 1 cm and 9 degrees).
    The expert's own action is what is recorded, so that the dataset shows how to recover from small errors.
    """

    def __post_init__(self) -> None:
        if self.num_episodes < 1:
            raise ValueError(f"--num_episodes must be at least 1, got {self.num_episodes}")
        if self.seed < 0:
            raise ValueError(f"--seed must not be negative, got {self.seed}")
        if not 0 <= self.noise <= 1:
            raise ValueError(f"--noise must lie in [0, 1], got {self.noise}")


def generate(config: GenerateConfig) -> Path:
    """Write the dataset that `config` describes and return its folder."""
    target = config.dataset.folder()
    with staged(target, "--dataset.root") as partial:
        from lerobot.datasets import LeRobotDataset

        env = config.env.make()
        dataset = LeRobotDataset.create(
            config.dataset.repo_id,
            fps=env.metadata["render_fps"],
            features=_features(env, config),
            root=partial,
            robot_type=config.env.robot,
            use_videos=False,
        )
        steps = 0
        for episode in tqdm(
            demonstrations(env, config), desc=config.env.task, total=config.num_episodes, unit="episode"
        ):
            for frame in episode:
                dataset.add_frame(frame | {"task": env.task_description})
            dataset.save_episode()
            steps += len(episode)
        dataset.finalize()
        env.close()
    logger.info("wrote %d demonstrations, %d frames, to %s", config.num_episodes, steps, target)
    return target


def demonstrations(env: Any, config: GenerateConfig) -> Iterator[Episode]:
    """Yield `config.num_episodes` successful episodes, each a list of dataset frames; failed ones are left out.

    Raises:
        CommandError: when more than a fifth of the episodes fail, which an expert's never do.
    """
    recorded, failed = 0, 0
    while recorded < config.num_episodes:
        episode = _demonstrate(env, FIRST_SEED * (config.seed + 1) + recorded + failed, config.noise)
        if episode is not None:
            recorded += 1
            yield episode
            continue
        failed += 1
        if failed > 5 and failed > MAX_FAILURE_RATE * (recorded + failed):
            raise CommandError(
                f"the expert failed {failed} of {recorded + failed} episodes: lower --noise or --env.start_jitter"
            )


def _demonstrate(env: Any, seed: int, noise: float) -> Episode | None:
    observation, _ = env.reset(seed=seed)
    disturbances = np.random.default_rng(seed)
    largest = np.append(env.action_space.high[:4], 0.0)  # the aperture is left alone
    frames: Episode = []
    done = False
    while not done:
        action = env.expert_action()
        before = observation
        disturbance = noise * largest * disturbances.standard_normal(len(action))
        observation, reward, terminated, truncated, info = env.step(action + disturbance)
        done = terminated or truncated
        frames.append(
            _frame(before, env.cameras)
            | {
                keys.ACTION: action,
                "next.reward": np.array([reward], dtype=np.float32),
                "next.done": np.array([done]),
                "next.success": np.array([info["is_success"]]),
            }
        )
    return frames if info["is_success"] else None


def _frame(observation: dict[str, Any], cameras: dict[str, Any]) -> dict[str, Any]:
    frame = {keys.STATE: observation["agent_pos"]}
    for name in cameras:
        frame[keys.rgb(name)] = observation["pixels"][name]
        frame[keys.depth(name)] = observation[keys.depth(name).removeprefix("observation.")].transpose(1, 2, 0)
        for key in (keys.intrinsics(name), keys.world_from_cam(name)):
            frame[key] = observation[key.removeprefix("observation.")]
    return frame


def _features(env: Any, config: GenerateConfig) -> Features:
    facts = {
        "workspace": asdict(env.workspace),
        "task": config.env.task,
        "seed": config.seed,
        "noise": config.noise,
        "placement": asdict(config.env.camera),
        "pybullet": version("pybullet"),
    }
    features: Features = {
        keys.STATE: {"dtype": "float32", "shape": (len(keys.STATE_NAMES),), "names": keys.STATE_NAMES},
        keys.ACTION: {"dtype": "float32", "shape": (len(keys.ACTION_NAMES),), "names": keys.ACTION_NAMES},
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
        "next.done": {"dtype": "bool", "shape": (1,), "names": None},
        "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    }
    for name, camera in env.cameras.items():
        features |= camera_features(name, camera.height, camera.width, facts)
    return features


def main() -> None:
    """Run the console command."""
    run_command(GenerateConfig, generate, EXAMPLES)
