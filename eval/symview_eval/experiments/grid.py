"""The cells that experiments consist of: one training run each, with its evaluations."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lerobot_symview.geometry.placement import CameraSpec, described
from lerobot_symview.registry import lookup
from symview_eval.experiments.rows import MethodRow
from symview_eval.experiments.scale import Algorithm, ChunkTraining, Scale
from symview_eval.experiments.tables import EXPERIMENTS, Experiment
from symview_sim.control import CONTROLS

HARDER_TASKS = ("block_in_bowl", "block_stacking")  # paper A.3: 50 demonstrations and twice the steps for SACfD
RL_DEMONSTRATIONS, RL_DEMONSTRATIONS_HARDER = 20, 50


@dataclass(frozen=True)
class Cell:
    """One training run and its evaluations."""

    experiment: str
    algorithm: Algorithm
    row: MethodRow
    task: str
    demonstrations: int
    seed: int
    scale: Scale

    @property
    def path(self) -> Path:
        """Its result file, relative to the results folder."""
        folder = Path(self.experiment, self.scale.name, self.task, self.row.name, str(self.demonstrations))
        return folder / f"{self.seed}.csv"

    @property
    def recording(self) -> str:
        """Name of its demonstrations, which all methods with the same camera share."""
        camera, others = self.row.camera, self.row.more_cameras
        azimuth = f"_azimuth{camera.azimuth_deg:g}" if camera.azimuth_deg else ""
        kind = f"{azimuth}{'_varying' if camera.varies else ''}{'' if camera.sees_robot else '_without_arm'}"
        cameras = "_".join([f"{camera.elevation_deg:g}deg{kind}", *(other.name for other in others)])
        world = "".join(f"_{value}" for value in self.world.values())
        return f"{self.task}{world}_{cameras}_{self.demonstrations}_seed{self.seed}"

    @property
    def world(self) -> dict[str, Any]:
        """Settings of the simulator."""
        return EXPERIMENTS[self.experiment].world

    @property
    def placements(self) -> tuple[tuple[str, CameraSpec], ...]:
        """Names and cameras of the evaluations after the training; empty if it has the demonstrations' camera only."""
        return EXPERIMENTS[self.experiment].placements

    @property
    def steps(self) -> int:
        """Training steps of behaviour cloning, or joint steps of reinforcement learning."""
        is_harder = self.task in HARDER_TASKS
        if self.chunks is not None:
            return self.row.longer * self.chunks.steps * (2 if is_harder else 1)
        if self.algorithm == "bc":
            return self.row.longer * (self.scale.harder_steps if is_harder else self.scale.steps)
        return self.scale.rl_steps * (2 if is_harder else 1)

    @property
    def batch_size(self) -> int:
        """Frames or transitions per step."""
        if self.chunks is not None:
            return self.chunks.batch_size
        return self.scale.batch_size if self.algorithm == "bc" else self.scale.rl_batch_size

    @property
    def chunks(self) -> ChunkTraining | None:
        """The training of its policy of action chunks; None for policies of single actions."""
        return self.scale.chunks[self.row.chunks] if self.row.chunks else None

    @property
    def policy_type(self) -> str:
        """LeRobot's type of its policy."""
        if self.chunks is not None:
            return self.chunks.type
        return "symview_bc" if self.algorithm == "bc" else "symview_sacfd"

    @property
    def policy_settings(self) -> dict[str, Any]:
        """The settings of its policy that the scale determines."""
        return self.scale.policy(self.algorithm) if self.chunks is None else self.chunks.policy

    @property
    def max_steps(self) -> int:
        """Actions per evaluation episode at most; the finer the control, the more."""
        control = CONTROLS[self.world.get("control", "coarse")]
        return self.scale.max_steps * control.max_steps // CONTROLS["coarse"].max_steps

    @property
    def eval_every(self) -> int:
        """Steps between evaluations during the training."""
        return self.steps // self.scale.evaluations if self.algorithm == "bc" else self.scale.rl_eval_every

    @property
    def eval_episodes(self) -> int:
        """Episodes per evaluation."""
        return self.scale.eval_episodes if self.algorithm == "bc" else self.scale.rl_eval_episodes

    @property
    def training(self) -> dict[str, Any]:
        """All settings that determine its policy and the evaluations during the training."""
        camera = self.row.camera
        return {
            "algorithm": self.algorithm,
            "policy": {**self.policy_settings, **self.row.policy},
            **({"chunks": self.row.chunks} if self.row.chunks else {}),
            **({} if self.policy_type.startswith("symview_") else {"sight": self.scale.crop_size}),
            **({"world": self.world} if self.world else {}),
            "elevation_deg": camera.elevation_deg,
            **({"placed": [camera.azimuth_deg, camera.distance]} if _is_placed(camera) else {}),
            **({"spread": asdict(camera.spread)} if camera.varies else {}),
            **({} if camera.sees_robot else {"sees_robot": False}),
            **(
                {"more_cameras": [described(other) for other in self.row.more_cameras]} if self.row.more_cameras else {}
            ),
            "task": self.task,
            "demonstrations": self.demonstrations,
            "seed": self.seed,
            "steps": self.steps,
            "batch_size": self.batch_size,
            "evaluation": [self.eval_every, self.eval_episodes, self.max_steps],
        }

    @property
    def training_hash(self) -> str:
        """Hash of `training`. Cells with equal hashes share one policy."""
        return _hash(self.training)

    @property
    def configuration_hash(self) -> str:
        """Hash of all settings that determine its result, not of versions and the machine.

        Cells of two tables with equal hashes share one run.
        """
        cameras = {name: described(camera) for name, camera in self.placements}
        episodes = self.scale.placement_episodes
        return _hash(self.training | {"placements": cameras, "episodes": episodes}) if cameras else self.training_hash

    def __str__(self) -> str:
        return f"{self.row.name} on {self.task}, {self.demonstrations} demonstrations, seed {self.seed}"


def _is_placed(camera: CameraSpec) -> bool:
    """Whether a camera has another azimuth or distance than the paper's."""
    paper = CameraSpec()
    return (camera.azimuth_deg, camera.distance) != (paper.azimuth_deg, paper.distance)


def _hash(settings: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def select(
    experiment: Experiment,
    scale: Scale,
    tasks: Sequence[str] = (),
    methods: Sequence[str] = (),
    demos: Sequence[int] = (),
    seeds: Sequence[int] = (),
) -> list[Cell]:
    """Return the cells of an experiment, seed by seed, so that every method's first seed runs first.

    Args:
        experiment: the experiment.
        scale: size of its runs.
        tasks: tasks to select; empty selects all. The same holds for the arguments below.
        methods: names of method rows.
        demos: numbers of demonstrations.
        seeds: seeds.

    Raises:
        ValueError: if the experiment has no such task or method.
    """
    rows = {row.name: row for row in experiment.rows}
    chosen_tasks = [lookup("--tasks entry", task, dict.fromkeys(experiment.tasks)) or task for task in tasks]
    chosen_rows = [lookup("--methods entry", method, rows) for method in methods]
    return [
        Cell(experiment.name, experiment.algorithm, row, task, demonstrations, seed, scale)
        for seed in seeds or range(scale.seeds)
        for task in chosen_tasks or experiment.tasks
        for demonstrations in demos or _demonstrations(experiment, scale, task)
        for row in chosen_rows or experiment.rows
    ]


def _demonstrations(experiment: Experiment, scale: Scale, task: str) -> tuple[int, ...]:
    if scale.demonstrations is not None:
        return scale.demonstrations
    if experiment.algorithm == "bc":
        return experiment.demonstrations
    return (RL_DEMONSTRATIONS_HARDER if task in HARDER_TASKS else RL_DEMONSTRATIONS,)
