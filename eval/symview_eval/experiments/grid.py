"""The paper's tables and figures: methods, tasks and numbers of demonstrations, and the cells they consist of."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lerobot_policy_symview.methods import METHODS
from lerobot_symview.geometry.miscalibration import Miscalibration
from lerobot_symview.geometry.placement import CameraSpec, CameraSpread
from lerobot_symview.registry import lookup
from lerobot_symview.views import ViewSpec
from symview_eval.experiments.scale import Algorithm, Scale
from symview_sim.tasks import TASK_NAMES

HARDER_TASKS = ("block_in_bowl", "block_stacking")  # paper A.3: 50 demonstrations and twice the steps for SACfD
RL_DEMONSTRATIONS, RL_DEMONSTRATIONS_HARDER = 20, 50


@dataclass(frozen=True)
class MethodRow:
    """A method, one row of a table."""

    name: str
    """Name of its result folder."""
    label: str
    """Its name in the paper."""
    policy: dict[str, Any] = field(hash=False)
    """Policy settings: `method`, and overrides of that method's settings."""
    camera: CameraSpec = field(default_factory=CameraSpec)
    """The camera of the demonstrations; by default the paper's, 45 degrees above the table."""
    more_cameras: tuple[CameraSpec, ...] = ()
    """Further cameras, which the view merges."""

    @property
    def remembers(self) -> bool:
        """Whether its view has memory, and must be added to the demonstrations before the training."""
        return bool(self.policy.get("view_options", {}).get("memory"))

    @property
    def policy_options(self) -> dict[str, Any]:
        """Constructor arguments of the policy's configuration: `view_options` are those of its method's view."""
        options = {name: value for name, value in self.policy.items() if name != "view_options"}
        if "view_options" in self.policy:
            options["view"] = ViewSpec(METHODS[options["method"]]["view"], self.policy["view_options"])
        return options


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
        kind = f"{'_varying' if camera.varies else ''}{'' if camera.sees_robot else '_without_arm'}"
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
            return self.scale.harder_steps if is_harder else self.scale.steps
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
        scale = self.scale
        return {
            "algorithm": self.algorithm,
            "policy": {**scale.policy(self.algorithm), **self.row.policy},
            "elevation_deg": self.row.camera.elevation_deg,
            **({"spread": asdict(self.row.camera.spread)} if self.row.camera.varies else {}),
            **({} if self.row.camera.sees_robot else {"sees_robot": False}),
            **({"more_cameras": [asdict(camera) for camera in self.row.more_cameras]} if self.row.more_cameras else {}),
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


def _hash(settings: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def _row(name: str, label: str, method: str | None = None, **policy: Any) -> MethodRow:
    return MethodRow(name, label, {"method": method or name, **policy})


def _rgb(method: str, label: str) -> MethodRow:
    return _row(f"{method}_rgb", label, method, modality="rgb")


ORACLE, ORACLE_RGB = _row("oracle_equi", "Oracle Equi"), _rgb("oracle_equi", "Oracle Equi")
REPROJ, PERSP = _row("reproj_equi", "Reproj. Equi"), _row("persp_equi", "Persp. Equi")
SIDE, SIDE_RGB = _row("sideview_equi", "Sideview Equi"), _rgb("sideview_equi", "Sideview Equi")
PLAIN, PLAIN_RGB = _row("sideview_nonequi", "Sideview NonEqui"), _rgb("sideview_nonequi", "Sideview NonEqui")
VOXEL, CLOUD = _row("voxel_equi", "Voxel Equi"), _row("point_cloud_equi", "Point Cloud Equi")

BROKEN = _row("persp_equi_broken", "Persp. Equi (broken)")
PLUCKER = _row("sideview_plucker", "Sideview Plücker")

CLONED_TASKS = ("block_picking", "block_pushing", "drawer_opening", "block_stacking", "block_in_bowl")
ABLATION_TASKS = ("drawer_opening", "block_stacking", "block_in_bowl")
ELEVATIONS = (15.0, 30.0, 45.0, 60.0, 75.0)


def _miscalibrated(**errors: float) -> CameraSpec:
    return CameraSpec(miscalibration=Miscalibration(**errors))


def _at_elevation(row: MethodRow, elevation_deg: float) -> MethodRow:
    camera = CameraSpec(elevation_deg=elevation_deg)
    return MethodRow(f"{row.name}_{elevation_deg:g}deg", f"{row.label}, {elevation_deg:g}°", row.policy, camera)


TRANSFERRED = (REPROJ, PERSP, BROKEN, SIDE, PLAIN, PLUCKER, VOXEL, CLOUD)
ANYWHERE = CameraSpread(elevation_deg=20.0, azimuth_deg=180.0)
PLACEMENTS = (
    ("training", CameraSpec()),
    *(
        (f"azimuth {azimuth:+d}°", CameraSpec(azimuth_deg=azimuth))
        for azimuth in (-135, -90, -45, -20, 20, 45, 90, 135)
    ),
    *((f"elevation {elevation}°", CameraSpec(elevation_deg=elevation)) for elevation in (15, 30, 60, 75)),
    ("distance 1.1 m", CameraSpec(distance=1.1)),
    ("field of view 60°", CameraSpec(fov_deg=60.0)),
    ("new in every episode", CameraSpec(spread=ANYWHERE)),
)


AUGMENTED = _row("reproj_equi_augmented", "Reproj. Equi, camera augmentation", "reproj_equi", camera_augmentation=1.0)
WITH_ERRORS = (REPROJ, AUGMENTED, PERSP, SIDE, PLAIN, VOXEL, CLOUD)
SENSORS = (
    ("exact", CameraSpec()),
    *((f"position {100 * metres:g} cm", _miscalibrated(position=metres)) for metres in (0.005, 0.01, 0.02, 0.03)),
    *((f"rotation {degrees:g}°", _miscalibrated(rotation_deg=degrees)) for degrees in (0.5, 1.0, 2.0, 5.0)),
    ("1 cm and 1°", _miscalibrated(position=0.01, rotation_deg=1.0)),
    *((f"focal length {100 * error:g} %", _miscalibrated(focal=error)) for error in (0.01, 0.025, 0.05)),
    *((f"depth noise {1000 * metres:g} mm", CameraSpec(depth_noise=metres)) for metres in (0.001, 0.0025, 0.005)),
    *((f"depth dropout {100 * share:g} %", CameraSpec(depth_dropout=share)) for share in (0.01, 0.1)),
    ("flying pixels 50 %", CameraSpec(flying_pixels=0.5)),
    ("late by an action", CameraSpec(delay=1)),
)


SECOND_CAMERA = CameraSpec("left", azimuth_deg=90.0)


def _seeing_more(name: str, label: str, *cameras: CameraSpec, arm: bool = True, memory: bool = False) -> MethodRow:
    merged = {"cameras": [camera.name for camera in cameras]} if cameras else {}
    options = merged | ({"memory": True} if memory else {})
    policy = {"method": "reproj_equi", **({"view_options": options} if options else {})}
    return MethodRow(f"reproj_equi_{name}", f"Reproj. Equi, {label}", policy, CameraSpec(sees_robot=arm), cameras)


def _with_varying_camera(row: MethodRow) -> MethodRow:
    camera = CameraSpec(spread=ANYWHERE)
    return MethodRow(f"{row.name}_varying", f"{row.label}, trained with many cameras", row.policy, camera)


def _with_plane_height(name: str, label: str, plane_height: float | str) -> MethodRow:
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
                _row(
                    "reproj_equi_occlusion",
                    "Nearest, or behind the occluder",
                    "reproj_equi",
                    view_options={"infill": "occlusion"},
                ),
                _row(
                    "reproj_equi_splat",
                    "Footprints of pixels, or behind the occluder",
                    "reproj_equi",
                    view_options={"infill": "splat"},
                ),
                _row("reproj_equi_local", "Local interpolation", "reproj_equi", view_options={"infill": "local"}),
                _row("reproj_equi_unfilled", "No interpolation", "reproj_equi", view_options={"infill": "none"}),
            ),
            ABLATION_TASKS,
        ),
        Experiment(
            "table5",
            "Plane height of the perspective view",
            (
                _row("persp_equi_broken", "0.0 cm"),
                _with_plane_height("persp_equi_broken_2.5cm", "2.5 cm", 0.025),
                _with_plane_height("persp_equi_broken_5cm", "5.0 cm", 0.05),
                _with_plane_height("persp_equi_broken_dynamic", "dynamic", "gripper"),
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
                *(_with_varying_camera(row) for row in TRANSFERRED),
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
                _seeing_more("memory", "memory", memory=True),
                _seeing_more("two_cameras", "two cameras", SECOND_CAMERA),
                _seeing_more("two_cameras_memory", "two cameras and memory", SECOND_CAMERA, memory=True),
                _seeing_more("without_arm", "arm not drawn", arm=False),
            ),
            CLONED_TASKS,
            (10,),
        ),
        Experiment(
            "figure7",
            "Elevation of the camera",
            (
                *(_at_elevation(row, elevation) for row in (REPROJ, SIDE, PLAIN) for elevation in ELEVATIONS),
                *(_at_elevation(row, elevation) for row in (PERSP, SIDE_RGB, PLAIN_RGB) for elevation in ELEVATIONS),
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
