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
    """Train a policy by soft actor-critic from demonstrations, in simulators that run beside the updates."""

    dataset: RecordedDataset = field(default_factory=RecordedDataset)
    """Demonstrations of the task, by the same cameras."""
    env: EnvSettings = field(default_factory=EnvSettings)
    """What is simulated."""
    policy: SymviewSacfdConfig = field(default_factory=SymviewSacfdConfig)
    """The policy and how it is updated."""
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    """What is remembered and sampled."""
    output_dir: Path = Path("outputs/train_rl")
    """Folder of the checkpoints, tables and logs."""
    steps: int = 5000
    """Joint steps: in each, every simulator takes one action and the networks are updated once."""
    batch_size: int = 128
    """Transitions per update; updates begin when so many are remembered."""
    num_simulators: int = 5
    """Simulators that run in parallel, each in a process of its own."""
    seed: int = 0
    """Of scenes, networks and sampling. On a CPU, the same seed gives the same run."""
    eval_every: int = 200
    """Steps between evaluations."""
    eval_episodes: int = 100
    """Episodes of each, on the scenes that `lerobot-eval` shows."""
    log_every: int = 20
    """Steps that a row of `training.csv` averages over."""
    save_every: int = 1000
    """Steps between checkpoints; the last one has what is needed to resume."""
    resume: bool = False
    """Go on from the last checkpoint in `output_dir`."""
    wandb: WandBConfig = field(default_factory=WandBConfig)
    """Logging to Weights & Biases: `--wandb.enable=true`, offline with `--wandb.mode=offline`."""

    def __post_init__(self) -> None:
        counts = ("steps", "batch_size", "num_simulators", "eval_every", "eval_episodes", "log_every", "save_every")
        for name in counts:
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} must be at least 1, got {getattr(self, name)}")
        if self.seed < 0:
            raise ValueError(f"--seed must not be negative, got {self.seed}")
        if self.policy.view == "top" and not self.env.oracle:
            raise ValueError(f"--policy.method={self.policy.method} sees the camera top: use --env.oracle=true")
