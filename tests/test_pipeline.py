"""The pipeline as a user runs it: console commands, on a tiny dataset."""

import json
import os
import subprocess
import sys
import tomllib
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from lerobot.scripts import lerobot_eval, lerobot_train

from symview_eval.demo import DemoConfig, demo
from symview_eval.demo_report import read_losses, read_success

pytestmark = pytest.mark.long
BIN = Path(sys.executable).parent
COMMANDS = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]["scripts"]


def run(*command, timeout=300):
    environment = os.environ | {"COLUMNS": "200"}
    return subprocess.run(
        [str(BIN / command[0]), *map(str, command[1:])],
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
        env=environment,
    )


@pytest.fixture(scope="module")
def tiny_demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    config = DemoConfig(output_dir=folder, demonstrations=2, steps=4, batch_size=4, eval_episodes=2)
    demo(config)
    return config


def test_every_stage_writes_its_result(tiny_demo):
    folder = tiny_demo.output_dir
    info = json.loads((folder / "views" / "meta" / "info.json").read_text())
    assert info["total_episodes"] == 2
    assert {"observation.images.side_reproj", "observation.images.side_persp"} <= set(info["features"])
    checkpoint = folder / "policy" / "checkpoints" / "last" / "pretrained_model"
    assert (checkpoint / "model.safetensors").is_file()
    assert json.loads((checkpoint / "config.json").read_text())["type"] == "symview_bc"
    losses = read_losses(next((folder / "logs").glob("*-training.log")))
    assert [point.step for point in losses] == [1, 2, 3, 4]
    assert all(0 < point.loss < 10 for point in losses)
    assert read_success(folder / "evaluation").episodes == 2


def test_report_is_self_contained(tiny_demo):
    page = (tiny_demo.output_dir / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 4
    assert page.count("data:video/mp4;base64,") == 4  # two episodes of each evaluation
    assert page.count("data:image/svg+xml;base64,") == 1
    for command in ("symview-generate", "symview-add-views", "lerobot-train", "lerobot-eval"):
        assert f"<pre>{command} " in page
    assert 'src="http' not in page
    assert "href=" not in page


def test_second_run_repeats_no_stage(tiny_demo):
    folder = tiny_demo.output_dir
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.safetensors")}
    record = (folder / "stages.json").read_text()
    demo(tiny_demo)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.safetensors")} == before
    assert (folder / "stages.json").read_text() == record


def test_checkpoint_is_evaluated_on_several_tasks(tiny_demo, tmp_path, monkeypatch):
    arguments = [
        "lerobot-eval",
        f"--policy.path={tiny_demo.output_dir / 'policy' / 'checkpoints' / 'last' / 'pretrained_model'}",
        "--policy.device=cpu",
        "--env.type=symview",
        "--env.task=block_picking,drawer_opening",
        "--env.max_steps=3",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        f"--output_dir={tmp_path}",
    ]
    monkeypatch.setattr(sys, "argv", arguments)
    lerobot_eval.main()
    evaluation = json.loads((tmp_path / "eval_info.json").read_text())
    assert sorted(evaluation["per_group"]) == ["block_picking", "drawer_opening"]
    assert evaluation["overall"]["n_episodes"] == 4


@pytest.mark.parametrize(
    ("command", "options"),
    [
        (lerobot_train.main, ("--policy.view", "--policy.crop_size", "--policy.augmentation", "--policy.method")),
        (lerobot_eval.main, ("--env.task", "--env.camera.elevation_deg", "--env.oracle", "--env.views")),
    ],
)
def test_help_of_lerobots_commands_lists_the_plugins_options(command, options, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["lerobot", "--policy.type=symview_bc", "--env.type=symview", "--help"])
    with pytest.raises(SystemExit, match="0"):
        command()
    help_text = capsys.readouterr().out
    assert [option for option in options if option not in help_text] == []


@pytest.mark.parametrize(
    ("command", "code", "message"),
    [
        (("symview-generate", "--dataset.repo_id=a/b", "--env.task=juggling"), 2, "unknown task 'juggling'"),
        (("symview-generate", "--dataset.repo_id=ab"), 2, "--dataset.repo_id must look like user/name, got 'ab'"),
        (("symview-generate", "--dataset.repo_id=a/b", "--num_episodes=many"), 2, "many"),
        (("symview-generate", "--dataset.repo_id=a/b", "--no_such_flag=1"), 2, "no_such_flag"),
        (
            ("symview-generate", "--dataset.repo_id=a/b", "--env.camera.elevation_deg=-5"),
            2,
            "elevation_deg must lie in (0, 90]",
        ),
        (("symview-add-views", "--dataset.repo_id=no/where", "--views=[reproj]"), 1, "there is no LeRobot dataset in"),
        (("symview-add-views", "--dataset.repo_id=a/b", "--views=[reprojj]"), 2, "did you mean 'reproj'"),
        (("symview-add-views", "--dataset.repo_id=a/b", "--workspace.size=-1"), 2, "must be positive metres, got -1"),
        (("symview-preview", "--dataset.repo_id=no/where"), 1, "there is no LeRobot dataset in"),
        (("symview-demo", "--steps=0"), 2, "--steps must be at least 1, got 0"),
    ],
)
def test_user_errors_are_one_line(command, code, message):
    result = run(*command)
    assert result.returncode == code
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_have_help_and_version(command, monkeypatch, capsys):
    (script,) = entry_points(group="console_scripts", name=command)
    for flag, prefix in (("--help", ""), ("--version", f"{command} 0.")):
        monkeypatch.setattr(sys, "argv", [command, flag])
        with pytest.raises(SystemExit, match="0"):
            script.load()()
        output = capsys.readouterr().out
        assert output.startswith(prefix)
        assert flag == "--version" or ("examples:" in output and f"  {command}" in output)


def test_preview_writes_an_image_a_page_and_a_rerun_recording(recorded, tmp_path):
    from PIL import Image

    result = run("symview-preview", "--dataset.repo_id=test/r", f"--root={recorded}", f"--output_dir={tmp_path}")
    assert result.returncode == 0, result.stderr
    assert "wrote " in result.stderr
    with Image.open(tmp_path / "preview.png") as image:
        assert image.size[0] > 1000
    assert (tmp_path / "preview.html").read_text().count("data:image/png;base64,") == 4 * 8
    assert (tmp_path / "preview.rrd").stat().st_size > 100_000
