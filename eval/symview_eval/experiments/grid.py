"""The paper's tables and figures: methods, tasks and numbers of demonstrations, and the cells they consist of."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.registry import lookup
from symview_eval.experiments.rows import (
    ABLATION_TASKS,
    BROKEN,
    CLONED_TASKS,
    CLOUD,
    ELEVATIONS,
    FOREIGN,
    FOREIGN_MOVED,
    ORACLE,
    ORACLE_RGB,
    PERSP,
    PLACEMENTS,
    PLAIN,
    PLAIN_RGB,
    REPROJ,
    SECOND_CAMERA,
    SENSORS,
    SIDE,
    SIDE_RGB,
    TRANSFERRED,
    VOXEL,
    WITH_ERRORS,
    MethodRow,
    at_elevation,
    method_row,
    seeing_more,
    with_plane_height,
    with_varying_camera,
)
from symview_eval.experiments.scale import Algorithm, Scale
from symview_eval.experiments.simulators import FOREIGN_TASKS
from symview_sim.tasks import TASK_NAMES

HARDER_TASKS = ("block_in_bowl", "block_stacking")  # paper A.3: 50 demonstrations and twice the steps for SACfD
RL_DEMONSTRATIONS, RL_DEMONSTRATIONS_HARDER = 20, 50


@dataclass(frozen=True)
class Experiment:
    """A table or figure of the paper."""

    name: str
    title: str
    rows: tuple[MethodRow, ...]
    tasks: tuple[str, ...]
    demonstrations: tuple[int, ...] = (5, 10, 50)
    """Numbers of demonstrations for behaviour cloning; for reinforcement learning the paper fixes one per task."""
    algorithm: Algorithm = "bc"
    placements: tuple[tuple[str, CameraSpec], ...] = ()
    """Names and cameras of the evaluations after the training; by default there is one camera, the demonstrations'."""


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
        return f"{self.task}_{cameras}_{self.demonstrations}_seed{self.seed}"

    @property
    def placements(self) -> tuple[tuple[str, CameraSpec], ...]:
        """Names and cameras of the evaluations after the training; empty if it has the demonstrations' camera only."""
        return EXPERIMENTS[self.experiment].placements

    @property
    def steps(self) -> int:
        """Training steps of behaviour cloning, or joint steps of reinforcement learning."""
        is_harder = self.task in HARDER_TASKS
        if self.algorithm == "bc":
            return self.row.longer * (self.scale.harder_steps if is_harder else self.scale.steps)
        return self.scale.rl_steps * (2 if is_harder else 1)

    @property
    def batch_size(self) -> int:
        """Frames or transitions per step."""
        return self.scale.batch_size if self.algorithm == "bc" else self.scale.rl_batch_size

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
        scale, camera = self.scale, self.row.camera
        return {
            "algorithm": self.algorithm,
            "policy": {**scale.policy(self.algorithm), **self.row.policy},
            "elevation_deg": camera.elevation_deg,
            **({"placed": [camera.azimuth_deg, camera.distance]} if _is_placed(camera) else {}),
            **({"spread": asdict(camera.spread)} if camera.varies else {}),
            **({} if camera.sees_robot else {"sees_robot": False}),
            **({"more_cameras": [asdict(other) for other in self.row.more_cameras]} if self.row.more_cameras else {}),
            "task": self.task,
            "demonstrations": self.demonstrations,
            "seed": self.seed,
            "steps": self.steps,
            "batch_size": self.batch_size,
            "evaluation": [self.eval_every, self.eval_episodes, scale.max_steps],
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
        cameras = {name: asdict(camera) for name, camera in self.placements}
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
                method_row("reproj_equi_relaxed", "Reproj. Equi (relaxed)"),
                method_row("reproj_equi_broken", "Reproj. Equi (broken)"),
                PERSP,
                method_row("persp_equi_relaxed", "Persp. Equi (relaxed)"),
                BROKEN,
            ),
            ABLATION_TASKS,
            (10,),
        ),
        Experiment(
            "table4",
            "Infill of the reprojected view",
            (
                MethodRow(REPROJ.name, "Nearest Interpolation", REPROJ.policy),
                method_row(
                    "reproj_equi_occlusion",
                    "Nearest, or behind the occluder",
                    "reproj_equi",
                    view_options={"infill": "occlusion"},
                ),
                method_row(
                    "reproj_equi_splat",
                    "Footprints of pixels, or behind the occluder",
                    "reproj_equi",
                    view_options={"infill": "splat"},
                ),
                method_row("reproj_equi_local", "Local interpolation", "reproj_equi", view_options={"infill": "local"}),
                method_row("reproj_equi_unfilled", "No interpolation", "reproj_equi", view_options={"infill": "none"}),
            ),
            ABLATION_TASKS,
        ),
        Experiment(
            "table5",
            "Plane height of the perspective view",
            (
                method_row("persp_equi_broken", "0.0 cm"),
                with_plane_height("persp_equi_broken_2.5cm", "2.5 cm", 0.025),
                with_plane_height("persp_equi_broken_5cm", "5.0 cm", 0.05),
                with_plane_height("persp_equi_broken_dynamic", "dynamic", "gripper"),
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
            "transfer",
            "A camera that is moved after the training",
            (
                *TRANSFERRED,
                *(with_varying_camera(row) for row in TRANSFERRED),
            ),
            CLONED_TASKS,
            (10,),
            placements=PLACEMENTS,
        ),
        Experiment(
            "robustness",
            "Errors of the camera that the training did not have",
            WITH_ERRORS,
            CLONED_TASKS,
            (10,),
            placements=SENSORS,
        ),
        Experiment(
            "hidden",
            "What the arm hides",
            (
                ORACLE,
                REPROJ,
                seeing_more("memory", "memory", memory=True),
                seeing_more("two_cameras", "two cameras", SECOND_CAMERA),
                seeing_more("two_cameras_memory", "two cameras and memory", SECOND_CAMERA, memory=True),
                seeing_more("without_arm", "arm not drawn", arm=False),
            ),
            CLONED_TASKS,
            (10,),
        ),
        Experiment("metaworld", "Simulators that others wrote", FOREIGN, FOREIGN_TASKS, (25,)),
        Experiment(
            "metaworld_moved",
            "Simulators that others wrote, and a camera that is moved after the training",
            FOREIGN,
            FOREIGN_TASKS,
            (25,),
            placements=FOREIGN_MOVED,
        ),
        Experiment(
            "figure7",
            "Elevation of the camera",
            (
                *(at_elevation(row, elevation) for row in (REPROJ, SIDE, PLAIN) for elevation in ELEVATIONS),
                *(at_elevation(row, elevation) for row in (PERSP, SIDE_RGB, PLAIN_RGB) for elevation in ELEVATIONS),
                ORACLE,
                ORACLE_RGB,
            ),
            CLONED_TASKS,
            (10,),
        ),
    )
}
"""Name -> experiment. In `figure7` the oracle's camera has an elevation of 90 degrees."""


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
