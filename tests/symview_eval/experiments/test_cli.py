"""`symview-experiment` end to end, at the scale `smoke`."""

import csv
import dataclasses
import json
import os
import re
import runpy
import shutil
import sys
from pathlib import Path

import pytest
from lerobot.scripts import lerobot_eval

from lerobot_policy_symview.rl.checkpoints import describe
from lerobot_symview.runtime.cli import CommandError
from lerobot_symview.runtime.locking import RUN_LOCK, locked
from symview_eval.experiments import cells as cells_module
from symview_eval.experiments import cli, queue
from symview_eval.experiments.cli import ExperimentConfig, run_experiment
from symview_eval.experiments.grid import select
from symview_eval.experiments.report import ReportConfig, report
from symview_eval.experiments.results import read_result
from symview_eval.experiments.scale import SCALES
from symview_eval.experiments.summary import placement_entries, table_entries
from symview_eval.experiments.tables import EXPERIMENTS

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[3]


def config(folder, **chosen):
    chosen = {"scale": "smoke", "num_workers": 1} | chosen
    return ExperimentConfig(results_dir=folder / "results", output_dir=folder / "output", **chosen)


@pytest.fixture(scope="module")
def table1(tmp_path_factory):
    """Folder with the results and policies of all of table 1."""
    folder = tmp_path_factory.mktemp("table1")
    run_experiment("table1", config(folder, num_workers=2))
    return folder


@pytest.fixture
def copied(table1, tmp_path):
    """A copy of `table1` that the test may change."""
    return shutil.copytree(table1, tmp_path / "table1")


def test_every_cell_of_table_1_has_a_result(table1):
    files = {path.relative_to(table1 / "results").parts for path in (table1 / "results").rglob("*.csv")}
    experiment = EXPERIMENTS["table1"]
    assert files == {
        ("table1", "smoke", task, row.name, "1", "0.csv") for task in experiment.tasks for row in experiment.rows
    }
    for path in (table1 / "results").rglob("*.csv"):
        result = read_result(path)
        assert [(point.step, point.episodes) for point in result.checkpoints] == [(1, 1), (2, 1)]
        assert result.times.cpu_s > 0
        assert result.times.training_s <= result.origin.seconds


def test_finished_cells_are_not_run_again(copied, monkeypatch):
    removed = sorted((copied / "results").rglob("*.csv"))[3]
    content = read_result(removed).checkpoints
    removed.unlink()
    ran = []
    run_cell = cells_module.run_cell
    monkeypatch.setattr(cells_module, "run_cell", lambda job: ran.append(job.cell) or run_cell(job))
    run_experiment("table1", config(copied))
    assert [copied / "results" / cell.path for cell in ran] == [removed]
    assert read_result(removed).checkpoints == content  # same seed, same run


def test_a_dry_run_tells_what_is_left_and_writes_nothing(copied, caplog):
    removed = sorted((copied / "results").rglob("*.csv"))[3]
    removed.unlink()
    before = sorted(copied.rglob("*"))
    caplog.set_level("INFO")
    run_experiment("all", config(copied, dry_run=True))
    assert "table1: 29 of 30 cells have a result" in caplog.messages
    assert re.search(
        r"\d+ runs are left, which serve \d+ cells: 0.\d hours of one core, and \d+ runs of unknown", caplog.text
    )
    assert sorted(copied.rglob("*")) == before


def test_equal_cells_of_all_experiments_run_once(tmp_path, monkeypatch):
    ran = []
    run_cell = cells_module.run_cell
    monkeypatch.setattr(cells_module, "run_cell", lambda job: ran.append(job.cell) or run_cell(job))
    monkeypatch.setattr(cli, "BATCH", 1)
    chosen = config(tmp_path, tasks=["block_stacking"], methods=["reproj_equi", "reproj_equi_local"])
    monkeypatch.setattr(queue, "EXPERIMENTS", {name: EXPERIMENTS[name] for name in ("table1", "table3", "table4")})
    run_experiment("all", chosen)
    assert [cell.row.name for cell in ran] == ["reproj_equi", "reproj_equi_local"]
    tables = {
        path.relative_to(tmp_path / "results").parts[0] for path in (tmp_path / "results").rglob("reproj_equi/*/0.csv")
    }
    assert tables == {"table1", "table3", "table4"}


def test_lerobot_eval_loads_the_policy_of_a_cell(table1, tmp_path, monkeypatch):
    (cell,) = select(EXPERIMENTS["table1"], SCALES["smoke"], ["block_picking"], ["reproj_equi"])
    policy = table1 / "output" / "policies" / cell.training_hash / "pretrained_model"
    arguments = [
        "lerobot-eval",
        f"--policy.path={policy}",
        "--policy.device=cpu",
        "--env.type=symview",
        "--env.max_steps=2",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        f"--output_dir={tmp_path}",
    ]
    monkeypatch.setattr(sys, "argv", arguments)
    lerobot_eval.main()
    assert json.loads((tmp_path / "eval_info.json").read_text())["overall"]["n_episodes"] == 1


def test_the_report_has_every_row_and_embeds_its_images(table1, tmp_path):
    page = report(ReportConfig(table1 / "results", tmp_path)).read_text()
    assert "scale=" not in page
    assert "name=smoke" in page
    assert page.count("<td>Reproj. Equi</td>") == 5
    assert "<th>best</th>" in page
    assert 'src="data:image/png' in page
    assert 'src="table1' not in page
    assert (tmp_path / "table1_smoke.png").read_bytes().startswith(b"\x89PNG")
    table = [line.split(" | ") for line in (tmp_path / "report.md").read_text().splitlines() if "Oracle Equi" in line]
    assert len(table) == 5


@pytest.mark.parametrize("name", [name for name in EXPERIMENTS if name != "table1"])
def test_every_experiment_runs_and_is_reported(name, tmp_path):
    rows = [row.name for row in EXPERIMENTS[name].rows][:3:2]
    rows += {row.chunks: row.name for row in EXPERIMENTS[name].rows if row.chunks not in ("", "symview_flow")}.values()
    tasks = EXPERIMENTS[name].tasks
    task = "block_stacking" if "block_stacking" in tasks else tasks[0]
    run_experiment(name, config(tmp_path, tasks=[task], methods=rows))
    assert len(list((tmp_path / "results" / name / "smoke" / task).rglob("0.csv"))) == len(rows)
    page = report(ReportConfig(tmp_path / "results", tmp_path / "report"))
    assert EXPERIMENTS[name].title in page.read_text()
    assert (page.parent / f"{name}_smoke.png").is_file()


def test_transfer_evaluates_the_policy_of_another_table_with_every_camera(copied, monkeypatch):
    monkeypatch.setattr(cells_module, "run_cloning", None)  # nothing is trained
    chosen = config(copied, tasks=["block_picking"], methods=["reproj_equi", "sideview_nonequi"])
    run_experiment("transfer", chosen)
    for path in (copied / "results" / "transfer").rglob("*.csv"):
        result = read_result(path)
        assert [point.camera for point in result.checkpoints] == [
            name for name, _ in EXPERIMENTS["transfer"].placements
        ]
        assert {(point.step, point.episodes) for point in result.checkpoints} == {(2, 1)}
        assert result.times.cpu_s > 0
    entries = placement_entries(EXPERIMENTS["transfer"], "smoke", copied / "results")
    assert [entry.row.name for entry in entries] == ["reproj_equi", "sideview_nonequi"]
    page = report(ReportConfig(copied / "results", copied / "report")).read_text()
    assert "azimuth +90°" in page
    assert (copied / "report" / "transfer_smoke.png").is_file()


def test_the_other_cells_run_after_one_fails(tmp_path, monkeypatch):
    run_cloning = cells_module.run_cloning

    def fail_for_one_method(cell, *arguments):
        if cell.row.name == "sideview_equi":
            raise RuntimeError("out of memory")
        return run_cloning(cell, *arguments)

    monkeypatch.setattr(cells_module, "run_cloning", fail_for_one_method)
    chosen = config(tmp_path, tasks=["block_picking"], methods=["sideview_equi", "sideview_nonequi"])
    with pytest.raises(CommandError, match=r"1 of 2 cells failed.*sideview_equi on block_picking.*out of memory"):
        run_experiment("table1", chosen)
    (result,) = (tmp_path / "results").rglob("*.csv")
    assert result.parts[-3] == "sideview_nonequi"
    with result.open() as stream:
        assert list(csv.DictReader(line for line in stream if not line.startswith("#")))


def test_the_other_cells_run_after_a_recording_fails(tmp_path):
    chosen = config(tmp_path, tasks=["block_pushing", "block_picking"], methods=["sideview_nonequi"])
    (tmp_path / "output" / "recordings" / "block_pushing_45deg_1_seed0").mkdir(parents=True)
    with pytest.raises(CommandError, match=r"1 of 2 cells failed.*sideview_nonequi on block_pushing.*exists"):
        run_experiment("table1", chosen)
    (result,) = (tmp_path / "results").rglob("*.csv")
    assert "block_picking" in result.parts


def test_a_changed_rl_cell_starts_from_the_beginning(tmp_path, monkeypatch):
    (cell,) = select(EXPERIMENTS["figure5"], SCALES["smoke"], ["block_picking"], ["sideview_nonequi"])
    job = cells_module.CellJob(cell, tmp_path / "results", tmp_path / "output", "cpu")
    resumed = []

    def train(configuration):
        """Write the files that a training writes: its flags and an evaluation."""
        resumed.append(configuration.resume)
        last = configuration.output_dir / "checkpoints" / "last" / "pretrained_model"
        last.mkdir(parents=True, exist_ok=True)
        (last / "train_config.json").write_text(json.dumps(describe(configuration)))
        (configuration.output_dir / "evaluation.csv").write_text("step,success,return\n1,1.0,0.5\n")
        state = last.parent / "training_state" / "state.json"
        state.parent.mkdir(exist_ok=True)
        state.write_text(json.dumps({"cpu_s": 12.5}))
        return last.parent

    monkeypatch.setattr(cells_module, "train_rl", train)
    longer = dataclasses.replace(cell, scale=dataclasses.replace(cell.scale, rl_steps=3))
    for next_cell in (cell, cell, longer):
        assert cells_module.run_cell(dataclasses.replace(job, cell=next_cell)).failure == ""
    assert resumed == [False, True, False]
    assert read_result(job.results / cell.path).times.cpu_s == 12.5


def test_a_second_run_is_refused_while_the_first_is_alive(tmp_path):
    chosen = config(tmp_path)
    with (
        locked(chosen.output_dir / RUN_LOCK, chosen.output_dir, "--output_dir"),
        pytest.raises(CommandError, match=rf"is being written by process {os.getpid()} on .*--output_dir"),
    ):
        run_experiment("table1", chosen)
    assert not chosen.results_dir.exists()


def test_cells_run_on_a_ray_cluster(table1, tmp_path):
    chosen = {"tasks": ["block_picking"], "methods": ["reproj_equi", "sideview_nonequi"]}
    run_experiment("table1", config(tmp_path, executor="ray", num_workers=2, **chosen))
    for path in (tmp_path / "results").rglob("*.csv"):
        assert read_result(path).checkpoints == read_result(table1 / path.relative_to(tmp_path)).checkpoints
    assert len(list((tmp_path / "results").rglob("*.csv"))) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tabel1"], "did you mean 'table1'"),
        ([], "expected one of: table1"),
        (["table1", "--scale=tiny"], "--scale 'tiny'"),
        (["table1", "--scale=smoke", "--tasks=[block_pulling]"], "'block_pulling'"),
        (["all", "--tasks=[block_puling]"], "did you mean 'block_pulling'"),
        (["all", "--methods=[reproj]"], "--methods entry 'reproj'"),
        (["table1", "--demos=[0]"], "--demos must be at least 1"),
        (["table1", "--num_workers=0"], "--num_workers must be at least 1"),
    ],
)
def test_wrong_arguments_give_a_one_line_error(arguments, message, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["symview-experiment", *arguments])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    *before, last = capsys.readouterr().err.splitlines()
    assert message in last
    assert "Traceback" not in "".join(before)


def test_a_report_without_results_names_the_remedy(tmp_path):
    with pytest.raises(CommandError, match="run symview-experiment table1 first"):
        report(ReportConfig(tmp_path))


def test_the_report_covers_the_committed_results(tmp_path):
    results = ROOT / "results"
    page = report(ReportConfig(results, tmp_path)).read_text()
    assert "computed with other settings" not in page
    assert "<th>success</th>" in page
    learning = [name for name in ("figure5", "figure6") if (results / name).exists()]  # the others have one checkpoint
    assert page.count("<th>best</th>") == len(learning)
    entries = table_entries(EXPERIMENTS["table1"], "laptop", results)
    assert sum(len(entry.results) for entry in entries) == len(list((results / "table1" / "laptop").rglob("*.csv")))


def test_tables_in_the_documentation_are_those_of_the_committed_results():
    tool = runpy.run_path(str(ROOT / "tools" / "results.py"))
    for page in tool["PAGES"]:
        text = page.read_text()
        assert tool["TABLE"].search(text)
        assert tool["updated"](text, ROOT / "results") == text, f"{page.name}: run python tools/results.py"
