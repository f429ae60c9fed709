"""Scales: sizes of an experiment's runs. One table never mixes scales."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal


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
    batch_size: int
    """Frames or transitions per training step."""
    eval_every: int
    """Training steps of behaviour cloning between evaluations."""
    eval_episodes: int
    """Episodes per evaluation."""
    rl_steps: int
    """Joint steps of reinforcement learning (five simulators act, one update); twice as many for the harder tasks."""
    rl_eval_every: int
    """Joint steps between evaluations."""
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
    dtype: str = "float32"
    """Precision of convolutions."""

    @property
    def policy(self) -> dict[str, Any]:
        """Policy settings that the scale determines."""
        names = ("width", "crop_size", "weight_averaging", "dtype")
        return {name: getattr(self, name) for name in names}

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
            batch_size=128,
            eval_every=200,
            eval_episodes=100,
            rl_steps=5000,
            rl_eval_every=200,
            simulators=16,
            dtype="bfloat16",
        ),
        Scale(
            "laptop",
            width=16,
            crop_size=64,
            steps=1000,
            batch_size=16,
            eval_every=200,
            eval_episodes=20,
            rl_steps=400,
            rl_eval_every=100,
            simulators=4,
            weight_averaging=0.99,
            learning_rate_decay="cosine",
        ),
        Scale(
            "smoke",
            width=16,
            crop_size=64,
            steps=2,
            batch_size=2,
            eval_every=1,
            eval_episodes=1,
            rl_steps=2,
            rl_eval_every=1,
            simulators=1,
            seeds=1,
            max_steps=2,
            demonstrations=(1,),
        ),
    )
}
"""Name -> scale. `paper`: the paper's appendix A.3 in bfloat16, for a GPU. `laptop`: two CPU cores. `smoke`: a check
that everything runs."""
