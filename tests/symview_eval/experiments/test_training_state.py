"""A behaviour cloning that was killed continues from its last checkpoint and ends with the same bits."""

import multiprocessing
import os
import signal
import threading
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file

from symview_eval.experiments import evaluator, training_state
from symview_eval.experiments.cells import CellJob, record_demonstrations, run_cell
from symview_eval.experiments.evaluator import Evaluator
from symview_eval.experiments.grid import select
from symview_eval.experiments.results import read_result
from symview_eval.experiments.scale import SCALES
from symview_eval.experiments.tables import EXPERIMENTS
from symview_eval.experiments.training_state import Checkpoints, Learner

STEPS = 6
SCALE = replace(
    SCALES["smoke"],
    steps=STEPS,
    evaluations=3,
    eval_episodes=2,
    weight_averaging=0.9,
    learning_rate_decay="cosine",
    aperture_noise=0.03,
)
ROWS = {"table1": "reproj_equi", "chunks": "flow_reproj_equi"}


def cell_job(folder, experiment):
    """Return a job whose policy has averaged weights, an annealed learning rate and noise in its training."""
    (cell,) = select(EXPERIMENTS[experiment], SCALE, ["block_picking"], [ROWS[experiment]])
    if cell.chunks is not None:
        cell = replace(cell, scale=replace(SCALE, chunks={cell.row.chunks: replace(cell.chunks, steps=STEPS)}))
    return CellJob(cell, folder / "results", folder / "output", "cpu")


def finish(job):
    """Run a job to its end; return its evaluations and weights."""
    assert run_cell(job).failure == ""
    weights = load_file(job.policy / "model.safetensors")
    return read_result(job.results / job.cell.path), weights


def run_until_killed(job, step, moment):
    """Write a checkpoint after every step; kill this process in a moment of that of `step`."""
    write, save, save_evaluations = Checkpoints.write, Learner.save, Evaluator.save

    def kill():
        os.kill(os.getpid(), signal.SIGKILL)

    def write_and_die(self, at, save):
        write(self, at, save)
        if at == step:
            kill()

    def save_and_die(self, folder):
        save(self, folder)
        if folder.name.startswith(f"{step:06d}"):
            kill()

    def save_finished(self, folder):
        self.results()
        return save_evaluations(self, folder)

    training_state.INTERVAL_S = 0.0
    if moment == "writing":
        Learner.save = save_and_die
    else:
        Checkpoints.write = write_and_die
    if moment == "evaluating":
        evaluator.evaluate = lambda *_: threading.Event().wait()
    if moment == "evaluated":
        Evaluator.save = save_finished
    run_cell(job)


@pytest.fixture(scope="module")
def references(tmp_path_factory):
    """The result and weights of uninterrupted runs, and the folder with their demonstrations, by experiment."""
    folder = tmp_path_factory.mktemp("uninterrupted")
    jobs = {experiment: cell_job(folder, experiment) for experiment in ROWS}
    for job in jobs.values():
        assert record_demonstrations(job).failure == ""
    return {experiment: (*finish(job), folder) for experiment, job in jobs.items()}


@pytest.mark.long
@pytest.mark.parametrize(
    ("experiment", "step", "moment", "resumed"),
    [
        ("table1", 2, "evaluating", 2),
        ("table1", 3, "evaluated", 3),
        ("table1", 5, "writing", 4),
        ("table1", STEPS, "evaluating", STEPS),
        ("chunks", 5, "evaluated", 5),  # draws noise, in the training and in the evaluations
    ],
)
def test_a_killed_cloning_ends_like_an_uninterrupted_one(
    experiment, step, moment, resumed, references, tmp_path, caplog
):
    result, weights, recorded = references[experiment]
    (tmp_path / "output").mkdir()
    (tmp_path / "output" / "recordings").symlink_to(recorded / "output" / "recordings")
    job = cell_job(tmp_path, experiment)
    process = multiprocessing.get_context("forkserver").Process(target=run_until_killed, args=(job, step, moment))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert not job.policy.exists()
    caplog.set_level("INFO")
    again, continued = finish(job)
    assert f"{job.cell} resumes after step {resumed} of {STEPS}" in caplog.messages
    assert again.checkpoints == result.checkpoints
    assert [point.step for point in again.checkpoints] == [2, 4, 6]
    assert continued.keys() == weights.keys()
    assert all(torch.equal(continued[name], values) for name, values in weights.items())
    assert again.times.wall_clock_s <= again.origin.seconds
    assert sorted(path.name for path in job.output.iterdir()) == ["pretrained_model"]


def test_a_cloning_of_seconds_writes_no_checkpoint(references, tmp_path, monkeypatch):
    result, _, recorded = references["table1"]
    (tmp_path / "output").mkdir()
    (tmp_path / "output" / "recordings").symlink_to(recorded / "output" / "recordings")
    monkeypatch.setattr(Checkpoints, "write", None)
    again, _ = finish(cell_job(tmp_path, "table1"))
    assert again.checkpoints == result.checkpoints


def write(folder, step, made_by="this version"):
    checkpoints = Checkpoints(folder, {"torch": made_by})
    checkpoints.write(step, lambda part: {"files": str(part), "loss": 0.1})
    return checkpoints


def test_a_checkpoint_replaces_the_earlier_ones_and_what_a_killed_run_left(tmp_path):
    (tmp_path / "000001.0123.part").mkdir()
    for step in (1, 2):
        checkpoints = write(tmp_path, step)
        assert [path.name for path in tmp_path.iterdir()] == [f"00000{step}"]
    folder, content = checkpoints.last()
    assert folder == tmp_path / "000002"
    assert (content["step"], content["loss"]) == (2, 0.1)
    assert content["files"].endswith(".part")  # written beside its place


def test_the_last_of_two_checkpoints_counts(tmp_path):
    """A run may be killed before it removes the earlier one."""
    write(tmp_path / "first", 90)
    write(tmp_path / "second", 100)
    (tmp_path / "first" / "000090").rename(tmp_path / "second" / "000090")
    folder, _ = Checkpoints(tmp_path / "second", {"torch": "this version"}).last()
    assert folder.name == "000100"


def test_cells_that_share_a_policy_have_checkpoints_of_their_own(tmp_path):
    """They may be trained at the same time."""
    chosen = {"tasks": ["block_picking"], "methods": ["reproj_equi"], "demos": [10], "seeds": [0]}
    cells = [cell for name in ("table1", "transfer") for cell in select(EXPERIMENTS[name], SCALE, **chosen)]
    jobs = [CellJob(cell, tmp_path / "results", tmp_path / cell.training_hash, "cpu") for cell in cells]
    assert jobs[0].policy == jobs[1].policy
    assert jobs[0].training_state != jobs[1].training_state


def test_checkpoints_of_other_software_are_not_read(tmp_path):
    assert write(tmp_path, 1, "another version").last() is not None
    assert Checkpoints(tmp_path, {"torch": "this version"}).last() is None
    assert write(tmp_path, 1).last() is not None  # of the same step
    assert Checkpoints(tmp_path / "none", {"torch": "this version"}).last() is None


def test_checkpoints_are_due_after_the_interval(tmp_path, monkeypatch):
    now = 1000.0
    monkeypatch.setattr(training_state.time, "monotonic", lambda: now)
    checkpoints = Checkpoints(tmp_path, {})
    now += training_state.INTERVAL_S - 1
    assert not checkpoints.is_due
    now += 1
    assert checkpoints.is_due
    checkpoints.write(1, lambda _: {})
    assert not checkpoints.is_due
