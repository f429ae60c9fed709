"""Runs one cell of an experiment in a worker process: demonstrations, training, evaluation, results."""

from __future__ import annotations

import logging
import os
import platform
import shutil
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import cast

import torch

from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.rl.checkpoints import cpu_seconds, last_checkpoint
from lerobot_policy_symview.rl.demonstrations import open_dataset
from lerobot_policy_symview.rl.metrics import read_table
from lerobot_policy_symview.rl.train_config import TrainRlConfig
from lerobot_policy_symview.rl.train_rl import train_rl
from lerobot_symview.datasets.add_views import AddViewsConfig, add_views
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.runtime.cli import CommandError
from lerobot_symview.runtime.staging import part_of
from symview_eval.experiments.actors import load_actor, save_actor, sight
from symview_eval.experiments.cloning import CloningResult, run_cloning
from symview_eval.experiments.grid import Cell
from symview_eval.experiments.placements import evaluate_placements
from symview_eval.experiments.results import Checkpoint, Origin, Result, Times, write_result
from symview_eval.experiments.simulators import world_settings
from symview_eval.experiments.training_state import Checkpoints, remove
from symview_sim.generate import GenerateConfig, RecordedWorld, generate
from symview_sim.settings import EnvSettings, NewDataset, WorldSettings

logger = logging.getLogger(__name__)

RL_SIMULATORS = 5


@dataclass(frozen=True)
class CellJob:
    """A cell, and the folders and device that it uses."""

    cell: Cell
    results: Path
    """Folder of the results of all cells."""
    folder: Path
    """Folder of the recordings and policies of all cells."""
    device: str
    """PyTorch device of the networks."""

    @property
    def demonstrations(self) -> NewDataset:
        """Location of the cell's demonstrations."""
        name = self.cell.recording
        return NewDataset(f"symview/{name}", self.folder / "recordings" / name)

    @property
    def training_data(self) -> NewDataset:
        """Location of the dataset that the cell trains on: the demonstrations, with a view that has memory."""
        if not self.cell.row.remembers:
            return self.demonstrations
        name = f"{self.cell.recording}_{self.cell.row.name}_{self.cell.scale.name}"
        return NewDataset(f"symview/{name}", self.folder / "recordings" / name)

    @property
    def output(self) -> Path:
        """Folder of the cell's policy, which all cells with the same training share."""
        return self.folder / "policies" / self.cell.training_hash

    @property
    def policy(self) -> Path:
        """Folder of the cloned policy."""
        return self.output / "pretrained_model"

    @property
    def training_state(self) -> Path:
        """Folder of the checkpoints of an unfinished cloning, of this cell alone: others may share its policy."""
        return self.output / f"training_state_{self.cell.configuration_hash}"


@dataclass(frozen=True)
class Outcome:
    """Whether a job succeeded, and its wall-clock time in seconds."""

    cell: Cell
    seconds: float
    failure: str = ""
    """Type and message of the error; empty if the job succeeded."""


def record_demonstrations(job: CellJob) -> Outcome:
    """Record a cell's demonstrations, unless they exist."""
    return _attempt(job, _record)


def run_cell(job: CellJob) -> Outcome:
    """Train and evaluate a cell's policy; save its results and the policy."""
    torch.set_num_threads(1)  # with more, sums differ in their last bits and so do trained weights
    return _attempt(job, _run)


def _attempt(job: CellJob, work: Callable[[CellJob], None]) -> Outcome:
    start = time.perf_counter()
    try:
        work(job)
    except Exception as error:  # any error: the other cells continue and the command reports it
        logger.debug("%s", traceback.format_exc())
        return Outcome(job.cell, time.perf_counter() - start, f"{type(error).__name__}: {error}")
    return Outcome(job.cell, time.perf_counter() - start)


def _record(job: CellJob) -> None:
    cell = job.cell
    cameras = {"camera": cell.row.camera, "more_cameras": cell.row.more_cameras}
    env = world_settings(cell.task, oracle=True, **cameras, **cell.world)
    recorded = cast(RecordedWorld, env)  # the flag `--env.type` needs a class of its own
    generate(
        GenerateConfig(job.demonstrations, recorded, num_episodes=cell.demonstrations, seed=cell.seed, resume=True)
    )
    if cell.row.remembers:
        source, target = job.demonstrations, job.training_data
        add_views(
            AddViewsConfig(
                HubDataset(source.repo_id, source.root),
                new_repo_id=target.repo_id,
                new_root=target.root,
                views=sight(cell, "cpu").views_to_make,
                resume=True,
            )
        )


def _run(job: CellJob) -> None:
    cell, start = job.cell, time.perf_counter()
    env = world_settings(
        cell.task,
        oracle=cell.row.policy["method"].startswith("oracle"),
        camera=cell.row.camera,
        more_cameras=cell.row.more_cameras,
        max_steps=cell.max_steps,
        **cell.world,
    )
    times, earlier_s = Times(), 0.0
    if cell.algorithm == "sacfd":
        assert isinstance(env, EnvSettings)
        checkpoints, times = _run_rl(job, env)
    elif cell.placements:
        if not job.policy.is_dir():
            earlier_s = _clone(job, env).earlier_s
        checkpoints, times = evaluate_placements(cell, load_actor(cell, job.policy), env)
    else:
        training = _clone(job, env)
        checkpoints, times, earlier_s = training.evaluations, training.times, training.earlier_s
    origin = Origin(
        configuration=cell.configuration_hash,
        seed=cell.seed,
        version=version("lerobot_policy_symview"),
        machine=_machine(job.device),
        seconds=time.perf_counter() - start + earlier_s,
        device=job.device,
    )
    write_result(job.results / cell.path, Result(origin, times, checkpoints))
    remove(job.training_state)


def _clone(job: CellJob, env: WorldSettings) -> CloningResult:
    """Start or resume a behaviour cloning, and save its policy."""
    made_by = {package: version(package) for package in ("lerobot_policy_symview", "lerobot", "torch")}
    saved = Checkpoints(job.training_state, made_by | {"device": job.device})
    training = run_cloning(job.cell, open_dataset(job.training_data), env, job.device, saved)
    part = part_of(job.policy)
    save_actor(training.actor, part)
    shutil.rmtree(job.policy, ignore_errors=True)
    part.rename(job.policy)
    return training


def _run_rl(job: CellJob, env: EnvSettings) -> tuple[list[Checkpoint], Times]:
    """Start or resume `symview-train-rl` for a cell; return its evaluations and its CPU time."""
    cell = job.cell
    config = TrainRlConfig(
        dataset=job.demonstrations,
        env=env,
        policy=SymviewSacfdConfig(
            device=job.device, push_to_hub=False, **cell.scale.policy(cell.algorithm), **cell.row.policy_options
        ),
        output_dir=job.output,
        steps=cell.steps,
        batch_size=cell.batch_size,
        num_simulators=RL_SIMULATORS,
        seed=cell.seed,
        eval_every=cell.eval_every,
        eval_episodes=cell.eval_episodes,
        save_every=cell.eval_every,
        resume=True,
    )
    try:
        last_checkpoint(config)
    except CommandError as error:  # no checkpoint yet, or one of another version's settings
        logger.info("%s: training starts from the beginning: %s", cell, error)
        shutil.rmtree(job.output, ignore_errors=True)
        config = replace(config, resume=False)
    last = train_rl(config)
    checkpoints = [
        Checkpoint(
            step=int(row["step"]),
            successes=round(row["success"] * cell.eval_episodes),
            episodes=cell.eval_episodes,
            mean_return=row["return"],
            loss=float("nan"),
        )
        for row in read_table(job.output / "evaluation.csv")
    ]
    return checkpoints, Times(cpu_s=cpu_seconds(last))


def _machine(device: str) -> str:
    gpu = f", {torch.cuda.get_device_name()}" if device.startswith("cuda") else ""
    return f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores{gpu}"
