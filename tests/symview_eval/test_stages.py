import sys
from pathlib import Path

import pytest

from lerobot_symview.runtime.cli import CommandError
from symview_eval.stages import Stage, run_stages

PYTHON = Path(sys.executable).name
COUNT = """
import pathlib, sys
path = pathlib.Path(sys.argv[1])
with path.with_suffix(".runs").open("a") as stream:
    stream.write("x")
path.write_text("done")
"""


def counting(path, name, extra=""):
    return Stage(name, (PYTHON, "-c", COUNT + extra, str(path)), path)


def runs(path):
    return len(path.with_suffix(".runs").read_text())


def test_finished_stages_are_skipped(tmp_path):
    stages = [counting(tmp_path / "a", "first"), counting(tmp_path / "b", "second")]
    seconds = run_stages(stages, tmp_path, {})
    assert seconds == run_stages(stages, tmp_path, {})
    assert runs(tmp_path / "a") == runs(tmp_path / "b") == 1


def test_a_rerun_continues_at_the_failed_stage(tmp_path):
    first = counting(tmp_path / "a", "first")
    failing = counting(tmp_path / "b", "second", extra="sys.exit(3)")
    with pytest.raises(CommandError, match=r"'second' failed with exit code 3.*2-second\.log"):
        run_stages([first, failing], tmp_path, {})
    run_stages([first, counting(tmp_path / "b", "second")], tmp_path, {})
    assert runs(tmp_path / "a") == 1
    assert runs(tmp_path / "b") == 2


def test_a_changed_command_or_missing_result_repeats_the_later_stages(tmp_path):
    stages = [counting(tmp_path / "a", "first"), counting(tmp_path / "b", "second")]
    run_stages(stages, tmp_path, {})
    (tmp_path / "a").unlink()
    run_stages(stages, tmp_path, {})
    assert runs(tmp_path / "a") == runs(tmp_path / "b") == 2
    run_stages([counting(tmp_path / "a", "first", extra=" "), stages[1]], tmp_path, {})
    assert runs(tmp_path / "b") == 3


def test_output_is_logged_and_the_environment_is_passed(tmp_path, capfd):
    code = "import os, sys, pathlib; print(os.environ['GREETING']); pathlib.Path(sys.argv[1]).touch()"
    stage = Stage("greet", (PYTHON, "-c", code, str(tmp_path / "g")), tmp_path / "g")
    run_stages([stage], tmp_path, {"GREETING": "hello"})
    assert (tmp_path / "logs" / "1-greet.log").read_text() == "hello\n"
    assert "hello" in capfd.readouterr().err
