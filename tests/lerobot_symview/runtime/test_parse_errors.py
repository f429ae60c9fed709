"""What a terminal shows for a wrong flag, of configurations of every kind."""

import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import draccus
import pytest

from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import run_command


@dataclass(frozen=True)
class Camera:
    height: int = 8
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self):
        if self.height < 2:
            raise OptionError(f"height must be at least 2, got {self.height}")


class Env(draccus.ChoiceRegistry):
    @classmethod
    def default_choice_name(cls):
        return "table"


@Env.register_subclass("table")
@dataclass(frozen=True)
class Table(Env):
    camera: Camera = field(default_factory=Camera)
    oracle: bool = True


@Env.register_subclass("floor")
@dataclass(frozen=True)
class Floor(Env):
    camera: Camera = field(default_factory=Camera)


@dataclass(frozen=True)
class Data:
    repo_id: str


@dataclass(frozen=True)
class Config:
    """An example."""

    data: Data
    env: Env = field(default_factory=Table)
    size: int = 3
    rate: float = 0.5
    resume: bool = False
    private: bool | None = None
    clip: Literal["gripper", "none"] | float = "gripper"
    origin: Literal["world", "base"] | None = None
    names: list[str] = field(default_factory=list)
    seeds: list[int] = field(default_factory=list)
    workspace: Workspace | None = None
    output: Path = Path("out")


GOOD = ["--data.repo_id=a/b"]
CASES = {
    "--sise=4": "unknown flag --sise; did you mean --size?",
    "--env.oracel=true": "unknown flag --env.oracel; did you mean --env.oracle?",
    "--entirely=different": "unknown flag --entirely",
    "--size": "--size needs a value: write --size=value",
    "--resume perhaps": "--resume must be true or false, got 'perhaps'",
    "--size=two": "--size must be an integer, got 'two'",
    "--size=2.5": "--size must be an integer, got '2.5'",
    "--rate=fast": "--rate must be a number, got 'fast'",
    "--resume=perhaps": "--resume must be true or false, got 'perhaps'",
    "--clip=gripprt": "--clip must be one of gripper, none or a number, got 'gripprt'; did you mean 'gripper'?",
    "--origin=wrld": "--origin must be one of world, base, got 'wrld'; did you mean 'world'?",
    "--names=one": "--names must be a list of names, such as [name1, name2], got 'one'",
    "--seeds=3": "--seeds must be a list of integers, such as [1, 2], got '3'",
    "--seeds=[1, a]": "--seeds[1] must be an integer, got 'a'",
    "--workspace.center=0.4": "--workspace.center must be a list of 2 numbers, such as [1, 2], got '0.4'",
    "--workspace.center=[0.4, x]": "--workspace.center[1] must be a number, got 'x'",
    "--workspace.size=-1": "--workspace: workspace size and height_limit must be positive metres, got -1 and 0.25",
    "--env.camera.target=[1, 2]": "--env.camera.target must have 3 entries, got 2",
    "--env.camera.height=1": "--env.camera: height must be at least 2, got 1",
    "--env.camera.height=high": "--env.camera.height must be an integer, got 'high'",
    "--env.type=flor": "argument --env.type: invalid choice: 'flor' (choose from 'table', 'floor')",
    "--env.type=floor --env.oracle=true": "unknown flag --env.oracle",
}


@pytest.mark.parametrize(("flags", "shown"), CASES.items(), ids=list(CASES))
def test_the_terminal_shows_one_line_with_flag_value_and_expectation(flags, shown, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["example", *GOOD, *re.split(r" (?=--|perhaps)", flags)])
    with pytest.raises(SystemExit) as end:
        run_command(Config, pytest.fail, "")
    assert end.value.code == 2
    assert capsys.readouterr().err == f"example: error: {shown}\n"


@pytest.mark.parametrize(
    ("flags", "resume", "oracle"),
    [
        (["--resume"], True, True),
        (["--resume", "--size=3"], True, True),
        (["--resume", "false"], False, True),
        (["--resume=false", "--env.oracle"], False, True),
        (["--env.oracle=false"], False, False),
        (["--private"], False, True),
    ],
    ids=str,
)
def test_a_boolean_flag_without_a_value_is_true(flags, resume, oracle, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["example", *GOOD, *flags])
    parsed = []
    with pytest.raises(SystemExit) as end:
        run_command(Config, parsed.append, "")
    assert end.value.code == 0
    assert (parsed[0].resume, parsed[0].env.oracle, parsed[0].size) == (resume, oracle, 3)
    assert parsed[0].private is (True if "--private" in flags else None)


def test_a_missing_flag_is_named(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["example", "--size=3"])
    with pytest.raises(SystemExit):
        run_command(Config, pytest.fail, "")
    assert capsys.readouterr().err.startswith("example: error: --data")
