"""Scales: sizes of an experiment's runs. One table never mixes scales."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

Algorithm = Literal["bc", "sacfd"]


@dataclass(frozen=True)
class ChunkTraining:
    """The training of one kind of policy of action chunks."""

    type: str
    """LeRobot's type of the policy."""
    steps: int
    """Training steps, twice as many for the harder tasks: of all kinds, they take about the same time."""
    batch_size: int
    """Samples per training step."""
    policy: dict[str, Any] = field(hash=False)
    """Policy settings."""


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
    chunks: dict[str, ChunkTraining] = field(default_factory=dict, hash=False, repr=False)
    """Kind of a policy of action chunks, ours or LeRobot's own -> its training."""

    def policy(self, algorithm: Algorithm) -> dict[str, Any]:
        """Return the policy settings that the scale determines."""
        names = ["width", "crop_size", "weight_averaging", "dtype"]
        if algorithm == "sacfd":
            return {name: getattr(self, name) for name in names} | self.rl_policy
        return {name: getattr(self, name) for name in [*names, "learning_rate_decay", "aperture_noise"]}

    def __str__(self) -> str:
        return ", ".join(f"{shown.name}={getattr(self, shown.name)}" for shown in fields(self) if shown.repr)


CHUNKS = {"n_obs_steps": 2, "horizon": 16, "n_action_steps": 8}
ACT_CHUNKS = {"chunk_size": 16, "n_action_steps": 8}
ACT_SINGLE = {"chunk_size": 4, "n_action_steps": 1}  # of coarse control, whose episodes have about 7 actions
FROM_SCRATCH = {"pretrained_backbone_weights": None}
PAPER = {"width": 64, "crop_size": 128, "dtype": "bfloat16"}
PAPER_POLICIES: dict[str, dict[str, Any]] = {
    "symview_flow": PAPER | CHUNKS,
    "symview_bc": PAPER | CHUNKS,
    "act": FROM_SCRATCH | ACT_CHUNKS,
    "act_single": FROM_SCRATCH | ACT_SINGLE,
    "diffusion": FROM_SCRATCH | CHUNKS | {"use_group_norm": True, "crop_shape": (128, 128)},
}
PAPER_CHUNKS = {
    kind: ChunkTraining(kind.removesuffix("_single"), 5000, 128, settings) for kind, settings in PAPER_POLICIES.items()
}
LAPTOP = {"width": 16, "crop_size": 64, "aperture_noise": 0.03, "weight_averaging": 0.99}
LAPTOP_FLOW_STEPS, LAPTOP_BATCH = 2000, 8
LAPTOP_STEP_MS = {"symview_flow": 88, "symview_bc": 70, "act": 320, "diffusion": 390}
"""Processor time of a training step: all kinds are trained for the time of flow matching."""
LAPTOP_ACT = FROM_SCRATCH | {
    "dim_model": 128,
    "n_heads": 4,
    "dim_feedforward": 512,
    "n_encoder_layers": 2,
    "use_vae": False,
    "optimizer_lr": 1e-4,
    "optimizer_lr_backbone": 1e-4,
}
LAPTOP_POLICIES: dict[str, dict[str, Any]] = {
    "symview_flow": LAPTOP | CHUNKS,
    "symview_bc": LAPTOP | CHUNKS | {"learning_rate_decay": "cosine"},
    "act": LAPTOP_ACT | ACT_CHUNKS,
    "act_single": LAPTOP_ACT | ACT_SINGLE,
    "diffusion": FROM_SCRATCH
    | CHUNKS
    | {
        "crop_shape": (64, 64),
        "use_group_norm": True,
        "down_dims": (64, 128, 256),
        "noise_scheduler_type": "DDIM",
        "num_inference_steps": 16,
        "optimizer_lr": 5e-4,
        "scheduler_warmup_steps": 50,
    },
}
"""Sizes that fit two cores. ResNet-18 is the smallest encoder that ACT and Diffusion Policy have."""


def _laptop_chunks(kind: str, settings: dict[str, Any]) -> ChunkTraining:
    """Return a training that takes as long as that of flow matching."""
    name = kind.removesuffix("_single")
    steps = LAPTOP_FLOW_STEPS * LAPTOP_STEP_MS["symview_flow"] // LAPTOP_STEP_MS[name]
    return ChunkTraining(name, steps, LAPTOP_BATCH, settings)


LAPTOP_CHUNKS = {kind: _laptop_chunks(kind, settings) for kind, settings in LAPTOP_POLICIES.items()}

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
            chunks=PAPER_CHUNKS,
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
            chunks=LAPTOP_CHUNKS,
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
            chunks={name: replace(training, steps=2, batch_size=2) for name, training in LAPTOP_CHUNKS.items()},
        ),
    )
}
"""Name -> scale. `paper`: the paper's appendix A.3 in bfloat16, for a GPU. `laptop`: two CPU cores. `smoke`: a check
that everything runs."""
