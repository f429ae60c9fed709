"""What the paper compares: the rows, tasks and numbers of demonstrations of its tables and figures."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from lerobot_policy_symview.methods import METHODS
from lerobot_symview.registry import lookup
from lerobot_symview.views import ViewSpec
from symview_eval.experiments.scale import Scale
from symview_sim.tasks import TASK_NAMES

Algorithm = Literal["bc", "sacfd"]
ELEVATION = 45.0  # degrees: the paper's camera, unless it says otherwise
HARDER_TASKS = ("block_in_bowl", "block_stacking")  # paper A.3: 50 demonstrations and twice the steps, for SACfD
RL_DEMONSTRATIONS, RL_DEMONSTRATIONS_HARDER = 20, 50


@dataclass(frozen=True)
class Row:
    """A method as one line of a table."""

    name: str
    """Its folder among the results."""
    label: str
    """As the paper prints it."""
    policy: dict[str, Any] = field(hash=False)
    """Settings of the policy: `method`, and what differs from it."""
    elevation_deg: float = ELEVATION
    """Of the camera, degrees above the table."""

    @property
    def policy_options(self) -> dict[str, Any]:
        """Constructor arguments of the policy's configuration: `view_options` are those of its method's view."""
        options = {name: value for name, value in self.policy.items() if name != "view_options"}
        if "view_options" in self.policy:
            options["view"] = ViewSpec(METHODS[options["method"]]["view"], self.policy["view_options"])
        return options


@dataclass(frozen=True)
class Experiment:
    """A table or figure."""

    name: str
    title: str
    rows: tuple[Row, ...]
    tasks: tuple[str, ...]
    demonstrations: tuple[int, ...] = (5, 10, 50)
    """Of behaviour cloning; reinforcement learning has as many as the paper gives each task."""
    algorithm: Algorithm = "bc"


@dataclass(frozen=True)
class Cell:
    """One training with its evaluations."""

    experiment: str
    algorithm: Algorithm
    row: Row
    task: str
    demonstrations: int
    seed: int
    scale: Scale

    @property
    def path(self) -> Path:
        """File of its results, in the folder of all results."""
        place = Path(self.experiment, self.scale.name, self.task, self.row.name, str(self.demonstrations))
        return place / f"{self.seed}.csv"

    @property
    def recording(self) -> str:
        """Name of its demonstrations, which every method learns from."""
        return f"{self.task}_{self.row.elevation_deg:g}deg_{self.demonstrations}_seed{self.seed}"

    @property
    def steps(self) -> int:
        """Training steps, joint ones for reinforcement learning."""
        if self.algorithm == "bc":
            return self.scale.steps
        return self.scale.rl_steps * (2 if self.task in HARDER_TASKS else 1)

    @property
    def configuration(self) -> dict[str, Any]:
        """What determines its results, but for versions and the machine."""
        shared = self.scale
        evaluation = [shared.eval_every if self.algorithm == "bc" else shared.rl_eval_every, shared.eval_episodes]
        return {
            "algorithm": self.algorithm,
            "policy": {**shared.policy, **self.row.policy},
            "learning_rate_decay": shared.learning_rate_decay if self.algorithm == "bc" else "none",
            "elevation_deg": self.row.elevation_deg,
            "task": self.task,
            "demonstrations": self.demonstrations,
            "seed": self.seed,
            "steps": self.steps,
            "batch_size": shared.batch_size,
            "evaluation": [*evaluation, shared.max_steps],
        }

    @property
    def configuration_hash(self) -> str:
        """Of `configuration`: equal for cells of two tables that are one run."""
        return hashlib.sha256(json.dumps(self.configuration, sort_keys=True).encode()).hexdigest()[:16]

    def __str__(self) -> str:
        return f"{self.row.name} on {self.task}, {self.demonstrations} demonstrations, seed {self.seed}"


def _row(name: str, label: str, method: str | None = None, elevation_deg: float = ELEVATION, **policy: Any) -> Row:
    return Row(name, label, {"method": method or name, **policy}, elevation_deg)


def _rgb(method: str, label: str) -> Row:
    return _row(f"{method}_rgb", label, method, modality="rgb")


ORACLE, ORACLE_RGB = _row("oracle_equi", "Oracle Equi"), _rgb("oracle_equi", "Oracle Equi")
REPROJ, PERSP = _row("reproj_equi", "Reproj. Equi"), _row("persp_equi", "Persp. Equi")
SIDE, SIDE_RGB = _row("sideview_equi", "Sideview Equi"), _rgb("sideview_equi", "Sideview Equi")
PLAIN, PLAIN_RGB = _row("sideview_nonequi", "Sideview NonEqui"), _rgb("sideview_nonequi", "Sideview NonEqui")
VOXEL, CLOUD = _row("voxel_equi", "Voxel Equi"), _row("point_cloud_equi", "Point Cloud Equi")

CLONED_TASKS = ("block_picking", "block_pushing", "drawer_opening", "block_stacking", "block_in_bowl")
ABLATION_TASKS = ("drawer_opening", "block_stacking", "block_in_bowl")
ANGLES = (15.0, 30.0, 45.0, 60.0, 75.0)


def _seen_from(row: Row, elevation_deg: float) -> Row:
    return Row(f"{row.name}_{elevation_deg:g}deg", f"{row.label}, {elevation_deg:g}°", row.policy, elevation_deg)


def _plane(name: str, label: str, plane_height: float | str) -> Row:
    return _row(name, label, "persp_equi_broken", view_options={"plane_height": plane_height})


EXPERIMENTS = {
    experiment.name: experiment
    for experiment in (
        Experiment(
            "table1",
            "Behaviour cloning from RGBD images",
            (ORACLE, REPROJ, SIDE, VOXEL, CLOUD, PLAIN),
            CLONED_TASKS,
        ),
        Experiment(
            "table2",
            "Behaviour cloning from RGB images",
            (ORACLE_RGB, PERSP, SIDE_RGB, PLAIN_RGB),
            CLONED_TASKS,
        ),
        Experiment(
            "table3",
            "Relaxed and broken symmetry",
            (
                REPROJ,
                _row("reproj_equi_relaxed", "Reproj. Equi (relaxed)"),
                _row("reproj_equi_broken", "Reproj. Equi (broken)"),
                PERSP,
                _row("persp_equi_relaxed", "Persp. Equi (relaxed)"),
                _row("persp_equi_broken", "Persp. Equi (broken)"),
            ),
            ABLATION_TASKS,
            (10,),
        ),
        Experiment(
            "table4",
            "Infill of the reprojected view",
            (
                Row(REPROJ.name, "Nearest Interpolation", REPROJ.policy),
                _row("reproj_equi_local", "Local interpolation", "reproj_equi", view_options={"infill": "local"}),
                _row("reproj_equi_unfilled", "No interpolation", "reproj_equi", view_options={"infill": "none"}),
            ),
            ABLATION_TASKS,
        ),
        Experiment(
            "table5",
            "Height of the plane of the perspective view",
            (
                _row("persp_equi_broken", "0.0 cm"),
                _plane("persp_equi_broken_2.5cm", "2.5 cm", 0.025),
                _plane("persp_equi_broken_5cm", "5.0 cm", 0.05),
                _plane("persp_equi_broken_dynamic", "dynamic", "gripper"),
            ),
            ABLATION_TASKS,
            (10,),
        ),
        Experiment(
            "figure5",
            "Soft actor-critic from demonstrations, RGBD images",
            (ORACLE, REPROJ, SIDE, CLOUD, PLAIN),
            TASK_NAMES,
            algorithm="sacfd",
        ),
        Experiment(
            "figure6",
            "Soft actor-critic from demonstrations, RGB images",
            (ORACLE_RGB, PERSP, SIDE_RGB, PLAIN_RGB),
            TASK_NAMES,
            algorithm="sacfd",
        ),
        Experiment(
            "figure7",
            "Angle of the camera",
            (
                *(_seen_from(row, angle) for row in (REPROJ, SIDE, PLAIN) for angle in ANGLES),
                *(_seen_from(row, angle) for row in (PERSP, SIDE_RGB, PLAIN_RGB) for angle in ANGLES),
                ORACLE,
                ORACLE_RGB,
            ),
            CLONED_TASKS,
            (10,),
        ),
    )
}
"""`figure7` compares with the oracle, whose camera hangs at 90 degrees."""


def select(
    experiment: Experiment,
    scale: Scale,
    tasks: Sequence[str] = (),
    methods: Sequence[str] = (),
    demos: Sequence[int] = (),
    seeds: Sequence[int] = (),
) -> list[Cell]:
    """Return the cells of an experiment, all or the named ones, seed by seed: every method's first seed comes first.

    Raises:
        ValueError: if it has no such task or method.
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
