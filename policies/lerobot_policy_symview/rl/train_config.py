"""Configuration of `symview-train-rl`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from lerobot.configs.default import WandBConfig

from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.rl.replay import ReplayConfig
from symview_sim.settings import EnvSettings, RecordedDataset


@dataclass(frozen=True)
class TrainRlConfig:
    """Train a policy by soft actor-critic from demonstrations (SACfD) in parallel simulators."""

    dataset: RecordedDataset = field(default_factory=RecordedDataset)
    """Demonstrations of the task, recorded with the same cameras."""
    env: EnvSettings = field(default_factory=EnvSettings)
    """Task, robot and cameras to simulate."""
    policy: SymviewSacfdConfig = field(default_factory=SymviewSacfdConfig)
    """The policy, its network and its updates."""
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    """Prioritised replay buffer."""
    output_dir: Path = Path("outputs/train_rl")
    """Folder of the checkpoints, metrics and logs."""
    steps: int = 5000
    """Training steps: in each, every simulator takes one action and the networks are updated once."""
    batch_size: int = 128
    """Transitions per update; updates start when the replay buffer holds as many."""
    num_simulators: int = 5
    """Simulators that run in parallel, each in its own process."""
    seed: int = 0
    """Random seed of scenes, networks and sampling. On a CPU, runs of the same seed are bit-identical."""
    eval_every: int = 200
    """Steps between evaluations."""
    eval_episodes: int = 100
    """Episodes per evaluation, on the scenes of `lerobot-eval`."""
    log_every: int = 20
    """Steps between rows of `training.csv`, which average over them."""
    save_every: int = 1000
    """Steps between checkpoints. Every checkpoint has the policy; only the last one can be resumed from."""
    resume: bool = False
    """Resume from the last checkpoint in `output_dir`."""
    wandb: WandBConfig = field(default_factory=WandBConfig)
    """Logging to Weights & Biases: `--wandb.enable=true`, offline with `--wandb.mode=offline`."""

    def __post_init__(self) -> None:
        counts = ("steps", "batch_size", "num_simulators", "eval_every", "eval_episodes", "log_every", "save_every")
        for name in counts:
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} must be at least 1, got {getattr(self, name)}")
        if self.seed < 0:
            raise ValueError(f"--seed must not be negative, got {self.seed}")
        if self.policy.view.name == "top" and not self.env.oracle:
            raise ValueError(f"--policy.method={self.policy.method} needs the camera 'top': use --env.oracle=true")
