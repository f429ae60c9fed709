"""`symview-demo`: the whole pipeline on one task, from demonstrations to an HTML report."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path

from lerobot_symview.runtime.cli import run_command
from lerobot_symview.runtime.locking import RUN_LOCK, locked
from symview_eval.demo_report import write_report
from symview_eval.stages import Stage, run_stages

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-demo
  symview-demo --output_dir=outputs/small --demonstrations=10 --steps=200 --eval_episodes=10"""

TASK = "block_picking"
REPO_ID = f"symview/{TASK}"
VIEWS_REPO_ID = f"{REPO_ID}_views"
MOVED_AZIMUTH_DEG = 90  # of the camera in the second evaluation; the demonstrations' camera faces the robot, at 0
VIEW_SIZE = 76  # pixels: half the camera image's, so that a camera pixel falls into nearly every pixel of the view


@dataclass(frozen=True)
class DemoConfig:
    """Record demonstrations, add views, train, evaluate and write a report, using the commands a user would type."""

    output_dir: Path = Path("outputs/demo")
    """Folder for all files; a second run continues an interrupted one."""
    demonstrations: int = 20
    """Expert episodes to record and train on."""
    steps: int = 2400
    """Training steps."""
    batch_size: int = 8
    """Frames per training step."""
    eval_episodes: int = 50
    """Evaluation episodes."""
    seed: int = 0
    """Seed of the demonstrations and the training."""

    def __post_init__(self) -> None:
        for name in ("demonstrations", "steps", "batch_size", "eval_episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} must be at least 1, got {getattr(self, name)}")


def stages(config: DemoConfig) -> list[Stage]:
    """Return the five commands of the pipeline."""
    names = ("recorded", "views", "policy", "evaluation", "evaluation_moved")
    recorded, views, policy, evaluation, moved = (config.output_dir / name for name in names)
    generate = (
        "symview-generate",
        f"--dataset.repo_id={REPO_ID}",
        f"--dataset.root={recorded}",
        f"--env.task={TASK}",
        f"--num_episodes={config.demonstrations}",
        f"--seed={config.seed}",
        "--num_workers=2",
        "--resume=true",
    )
    # Only the views go into the training set: LeRobot decodes every image of a frame, used or not.
    add_views = (
        "symview-add-views",
        f"--dataset.repo_id={REPO_ID}",
        f"--dataset.root={recorded}",
        f"--new_repo_id={VIEWS_REPO_ID}",
        f"--new_root={views}",
        "--views=[reproj, persp]",
        f"--size={VIEW_SIZE}",
        "--keep=[]",
    )
    train = train_command(config, VIEWS_REPO_ID, views, policy, "--policy.view=reproj")
    evaluate = evaluate_command(config, policy, evaluation)
    evaluate_moved = evaluate_command(config, policy, moved, f"--env.camera.azimuth_deg={MOVED_AZIMUTH_DEG}")
    return [
        Stage("demonstrations", generate, recorded),
        Stage("views", add_views, views),
        Stage("training", train, policy),
        Stage("evaluation", evaluate, evaluation),
        Stage("evaluation with the camera moved", evaluate_moved, moved),
    ]


def train_command(config: DemoConfig, repo_id: str, dataset: Path, output: Path, *options: str) -> tuple[str, ...]:
    """Return the command that trains a small policy on a CPU; `options` are flags that choose the policy."""
    return (
        "lerobot-train",
        f"--dataset.repo_id={repo_id}",
        f"--dataset.root={dataset}",
        "--policy.type=symview_bc",
        *options,
        "--policy.width=16",
        "--policy.crop_size=64",
        "--policy.learning_rate_decay=cosine",
        "--policy.weight_averaging=0.99",
        "--policy.aperture_noise=0.03",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        f"--steps={config.steps}",
        f"--batch_size={config.batch_size}",
        "--num_workers=0",
        f"--log_freq={max(1, config.steps // 40)}",
        f"--save_freq={config.steps}",
        "--env_eval_freq=0",
        f"--seed={config.seed}",
        f"--output_dir={output}",
    )


def evaluate_command(config: DemoConfig, policy: Path, output: Path, *options: str) -> tuple[str, ...]:
    """Return the command that evaluates the policy that `train_command` wrote to the folder `policy`.

    `options` are flags of the environment.
    """
    return (
        "lerobot-eval",
        f"--policy.path={policy / 'checkpoints' / 'last' / 'pretrained_model'}",
        "--policy.device=cpu",
        "--env.type=symview",
        f"--env.task={TASK}",
        *options,
        f"--eval.n_episodes={config.eval_episodes}",
        f"--eval.batch_size={min(config.eval_episodes, 10)}",
        "--eval.use_async_envs=false",
        f"--output_dir={output}",
    )


def demo(config: DemoConfig) -> Path:
    """Run the pipeline and return the report's path."""
    # Hugging Face's libraries must not use the network, and their cache belongs to the results.
    environment = {"HF_HUB_OFFLINE": "1", "HF_DATASETS_CACHE": str(config.output_dir.resolve() / "cache")}
    pipeline = stages(config)
    os.environ |= environment
    report = config.output_dir / "report.html"
    with locked(config.output_dir / RUN_LOCK, config.output_dir, "--output_dir"):
        before = (config.output_dir / "stages.json").read_bytes() if report.exists() else b""
        seconds = run_stages(pipeline, config.output_dir, environment)
        if (config.output_dir / "stages.json").read_bytes() != before:
            write_report(report, pipeline, seconds)
    logger.info("report: %s", report.resolve())
    return report


def main() -> None:
    """Run the console command."""
    run_command(DemoConfig, demo, EXAMPLES)
