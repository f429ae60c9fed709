"""How large the runs of an experiment are. Scales are never mixed in one table."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal


@dataclass(frozen=True)
class Scale:
    """What every run of a table has in common."""

    name: str
    """Its folder among the results."""
    width: int
    """Fields n of the network."""
    crop_size: int
    """Pixels the network sees."""
    steps: int
    """Training steps of behaviour cloning."""
    batch_size: int
    """Frames or transitions per step."""
    eval_every: int
    """Steps between evaluations."""
    eval_episodes: int
    """Episodes of each."""
    rl_steps: int
    """Joint steps of reinforcement learning (five simulators act, one update); twice as many for the harder tasks."""
    rl_eval_every: int
    """Joint steps between evaluations."""
    simulators: int
    """Scenes that evaluation runs side by side."""
    seeds: int = 3
    """Runs of each kind, unless `--seeds` says otherwise."""
    max_steps: int = 50
    """Actions per episode of an evaluation."""
    demonstrations: tuple[int, ...] | None = None
    """In place of the experiment's own numbers of them."""
    weight_averaging: float = 0.0
    """Decay of the average of the weights that acts in evaluation."""
    learning_rate_decay: Literal["none", "cosine"] = "none"
    """Of behaviour cloning; `cosine` lowers the rate to zero."""
    dtype: str = "float32"
    """Precision of convolutions."""

    @property
    def policy(self) -> dict[str, Any]:
        """Settings that every policy of the scale has."""
        names = ("width", "crop_size", "weight_averaging", "dtype")
        return {name: getattr(self, name) for name in names}

    def __str__(self) -> str:
        return ", ".join(f"{entry.name}={getattr(self, entry.name)}" for entry in fields(self))


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
"""`paper` is its appendix A.3 in bfloat16, for a GPU; `laptop` is for two cores, `smoke` shows that everything runs."""
