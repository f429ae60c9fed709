"""The paper's tables and figures, and experiments of our own: methods, tasks and numbers of demonstrations."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lerobot_symview.geometry.placement import CameraSpec
from symview_eval.experiments.rows import (
    ABLATION_TASKS,
    BROKEN,
    CHUNKED,
    CHUNKS_MOVED,
    CLONED_TASKS,
    CLOUD,
    ELEVATIONS,
    FOREIGN,
    FOREIGN_MOVED,
    LENSES,
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
from symview_eval.experiments.scale import Algorithm
from symview_eval.experiments.simulators import FOREIGN_TASKS
from symview_sim.tasks import TASK_NAMES


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
    world: dict[str, Any] = field(default_factory=dict, hash=False)
    """Settings of the simulator; by default its own."""


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
            "lens",
            "A lens that the training did not have",
            WITH_ERRORS,
            CLONED_TASKS,
            (10,),
            placements=LENSES,
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
            "chunks",
            "Action chunks, demonstrations in the style of people",
            CHUNKED,
            CLONED_TASKS,
            (25,),
            world={"control": "fine", "style": "human"},
        ),
        Experiment(
            "chunks_planner",
            "Action chunks, demonstrations of the planner",
            CHUNKED,
            CLONED_TASKS,
            (25,),
            world={"control": "fine"},
        ),
        Experiment(
            "chunks_moved",
            "Action chunks, and a camera that is moved after the training",
            CHUNKED,
            CLONED_TASKS,
            (25,),
            placements=CHUNKS_MOVED,
            world={"control": "fine", "style": "human"},
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
