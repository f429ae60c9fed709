"""Scales: sizes of an experiment's runs. One table never mixes scales."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Literal

Algorithm = Literal["bc", "sacfd"]


@dataclass(frozen=True)
class Scale:
    """Sizes and settings that all runs of a table share."""

    name: str
    """Name of its result folder."""
    width: int
    """Width n of the network: regular fields per layer."""
    crop_size: int
    """Rows and columns of the crop that the network takes, pixels."""
    steps: int
    """Training steps of behaviour cloning."""
    harder_steps: int
    """Training steps of behaviour cloning for the harder tasks."""
    batch_size: int
    """Frames per training step of behaviour cloning."""
    evaluations: int
    """Evaluations of behaviour cloning, after equal numbers of training steps, the last one after the last step."""
    eval_episodes: int
    """Episodes per evaluation of behaviour cloning."""
    placement_episodes: int
    """Episodes per camera, in experiments with several cameras."""
    rl_steps: int
    """Joint steps of reinforcement learning (five simulators act, one update); twice as many for the harder tasks."""
    rl_batch_size: int
    """Transitions per joint step."""
    rl_eval_every: int
    """Joint steps between evaluations."""
    rl_eval_episodes: int
    """Episodes per evaluation of reinforcement learning."""
    simulators: int
    """Simulators that evaluate in parallel (behaviour cloning)."""
    seeds: int = 3
    """Runs per cell of a table, seeds 0, 1, …; `--seeds` overrides it."""
    max_steps: int = 50
    """Actions per evaluation episode at most."""
    demonstrations: tuple[int, ...] | None = None
    """Numbers of demonstrations that replace the experiment's."""
    weight_averaging: float = 0.0
    """Decay of the exponential moving average of the weights, which is evaluated; 0 turns it off."""
    learning_rate_decay: Literal["none", "cosine"] = "none"
    """Learning rate schedule of behaviour cloning; `cosine` decays the rate to zero."""
    aperture_noise: float = 0.0
    """Noise on the gripper's aperture in the training of behaviour cloning."""
    rl_policy: dict[str, Any] = field(default_factory=dict, hash=False)
    """Policy settings of reinforcement learning."""
    dtype: str = "float32"
    """Precision of convolutions."""

    def policy(self, algorithm: Algorithm) -> dict[str, Any]:
        """Return the policy settings that the scale determines."""
        names = ["width", "crop_size", "weight_averaging", "dtype"]
        if algorithm == "sacfd":
            return {name: getattr(self, name) for name in names} | self.rl_policy
        return {name: getattr(self, name) for name in [*names, "learning_rate_decay", "aperture_noise"]}

    def __str__(self) -> str:
        return ", ".join(f"{setting.name}={getattr(self, setting.name)}" for setting in fields(self))


SCALES = {
    scale.name: scale
    for scale in (
        Scale(
            "paper",
            width=64,
            crop_size=128,
            steps=5000,
            harder_steps=5000,
            batch_size=128,
            evaluations=25,
            eval_episodes=100,
            placement_episodes=100,
            rl_steps=5000,
            rl_batch_size=128,
            rl_eval_every=200,
            rl_eval_episodes=100,
            simulators=16,
            dtype="bfloat16",
        ),
        Scale(
            "laptop",
            width=16,
            crop_size=64,
            steps=2000,
            harder_steps=4000,
            batch_size=8,
            evaluations=1,
            eval_episodes=60,
            placement_episodes=20,
            rl_steps=750,
            rl_batch_size=32,
            rl_eval_every=150,
            rl_eval_episodes=20,
            simulators=4,
            weight_averaging=0.99,
            learning_rate_decay="cosine",
            aperture_noise=0.03,
            rl_policy={"bc_weight": 10.0, "grad_clip_norm": 10.0, "learning_rate_decay": "cosine"},
        ),
        Scale(
            "smoke",
            width=16,
            crop_size=64,
            steps=2,
            harder_steps=2,
            batch_size=2,
            evaluations=2,
            eval_episodes=1,
            placement_episodes=1,
            rl_steps=2,
            rl_batch_size=2,
            rl_eval_every=1,
            rl_eval_episodes=1,
            simulators=1,
            seeds=1,
            max_steps=2,
            demonstrations=(1,),
        ),
    )
}
"""Name -> scale. `paper`: the paper's appendix A.3 in bfloat16, for a GPU. `laptop`: two CPU cores. `smoke`: a check
that everything runs."""
