"""Runs every script in `examples/` as a user does, at a scale of seconds; a new script needs an entry in `TRIALS`."""

import ast
import logging
import re
import runpy
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from symview_sim.settings import EnvSettings
from tests.helpers.packages import temporary_registrations
from tests.helpers.so101 import convert, record, view
from tests.helpers.training import train
from tests.hub.client import online
from tests.hub.server import ALICE, HubServer

pytestmark = pytest.mark.long

EXAMPLES = Path(__file__).parent.parent / "examples"
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))
LONGEST = 60  # lines
ONLINE = ("push_to_the_hub",)


@dataclass(frozen=True)
class Trial:
    """How an example is run, and its expected results."""

    arguments: str
    """Its command line, with the folders `recorded`, `with_views`, `joints_policy` and `output`."""
    log_lines: tuple[str, ...]
    """Regular expressions of lines that it logs."""
    files: tuple[str, ...] = ()
    """Files that it writes to `output`."""


TRIALS = {
    "action_chunks": Trial(
        "--demonstrations=1 --steps=1 --episodes=1 --output_dir={output}",
        (r"(0|100) % of 1 episodes succeed",),
        ("flow/checkpoints/last/pretrained_model/model.safetensors", "evaluation/eval_info.json"),
    ),
    "add_views": Trial(
        "--dataset={recorded} --size=40 --output_dir={output}",
        (r"side_reproj +\(3, 40, 40\)", r"side_reproj_height +\(1, 40, 40\)", r"side_persp +\(3, 40, 40\)"),
        ("views.png", "picking_views/meta/symview_views.json"),
    ),
    "own_camera": Trial(
        "--output_dir={output}",
        (
            r"7 frames with .*front, .*front_depth, .*front_persp, .*front_reproj, .*front_reproj_height$",
            r"camera is at \(0\.93, 0\.00, 0\.64\) m",
        ),
        ("real/meta/info.json", "real_views/meta/symview_views.json"),
    ),
    "own_encoder": Trial("--width=16", (r"transformed: errors up to \de-0[67]$", r"plain: errors up to \de[+-]0[01]$")),
    "own_robot": Trial(
        "--width=16",
        (
            "correct declaration: equivariant",
            r"wrong declaration, rotated by 90 degrees: \de-0[5-7]$",
            r"wrong declaration, reflected, rotated by 0 degrees: \de[+-]0[01]$",
        ),
    ),
    "own_task": Trial("--episodes=3", ("3 demonstrations in 3 attempts",)),
    "own_view": Trial(
        "--size=40 --output_dir={output}",
        (r"7 images \(3, 40, 40\) by ReliefView\(size=40, highest=0\.1\)",),
        ("relief/meta/symview_views.json",),
    ),
    "push_to_the_hub": Trial(
        "--repo_id=alice/example --episodes=1 --output_dir={output}",
        ("pulled 1 episodes of alice/example$", "pulled .*side_reproj_height of alice/example_views$"),
        ("recorded/README.md", "views/README.md"),
    ),
    "record_demonstrations": Trial(
        "--task=block_pushing --azimuth_deg=90 --episodes=2 --output_dir={output}/new",
        (
            r"2 episodes, \d+ frames: Push the red block onto the blue square\.",
            r"observation\.images\.front_depth +image +\(120, 160, 1\)",
            r"camera is at \(0\.\d+, 0\.6\d, 0\.52\) m",
        ),
        ("new/meta/symview_recording.json",),
    ),
    "reinforcement_learning": Trial(
        "--demonstrations=5 --steps=1 --simulators=1 --episodes=1 --output_dir={output}",
        ("^step,success,return$", r"^1,[01]\.0,", r"the policy is in .*000001/pretrained_model$"),
        ("sacfd/checkpoints/last/pretrained_model/model.safetensors", "sacfd/training.csv"),
    ),
    "so101_record": Trial(
        "--episodes=2 --root={output}/so101",
        ("episode 1: the cube is lifted", r"\d+ frames in .*so101$"),
        ("so101/meta/info.json",),
    ),
    "so101_rollouts": Trial(
        "--policy={joints_policy} --scenes=1 --seconds=0.2",
        ("scene 100000: failed, 0 so far", "0 of 1 cubes are lifted"),
    ),
    "stock_policy_on_views": Trial(
        "--demonstrations=1 --steps=1 --episodes=1 --output_dir={output}",
        (r"ACT succeeds in \d+ % of 1 episodes",),
        ("act/checkpoints/last/pretrained_model/model.safetensors", "evaluation/eval_info.json"),
    ),
    "train_and_evaluate": Trial(
        "--dataset={with_views} --steps=1 --episodes=1 --output_dir={output}",
        ("[01] of 1 episodes succeed",),
        ("policy/checkpoints/last/pretrained_model/model.safetensors",),
    ),
    "view_of_one_image": Trial(
        "--seed=3 --elevation_deg=50 --output={output}/views.png",
        (r"the block is at x = 0\.\d+ m, y = -?0\.\d+ m",),
        ("views.png",),
    ),
    "why_success_swings": Trial(
        "--steps=2 --episodes=1 --demonstrations=1 --noise=0.03 --output_dir={output}",
        (r"step 000001: \d+ %, \d+ % as if open$", r"step 000002: \d+ %, \d+ % as if open$"),
        ("policy_0.03_0/checkpoints/last/pretrained_model/model.safetensors",),
    ),
}


@pytest.fixture
def isolated_registrations_and_loggers():
    """Undo an example's registrations and its, or LeRobot's, changes to the root logger."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    with temporary_registrations():
        yield
    root.handlers[:], root.level = handlers, level


@pytest.fixture
def joints_policy(tmp_path, monkeypatch):
    """A checkpoint of the simulated arm."""
    return train(monkeypatch, view(convert(record(monkeypatch, tmp_path / "so101"))), tmp_path / "run")


@pytest.fixture
def run(request, recorded, with_views, tmp_path, monkeypatch, caplog, isolated_registrations_and_loggers):
    """Return a function that runs an example and returns its log messages."""

    def run(name, arguments):
        folders = {"recorded": recorded, "with_views": with_views, "output": tmp_path}
        if "{joints_policy}" in arguments:
            folders["joints_policy"] = request.getfixturevalue("joints_policy")
        command_line = arguments.format(**folders)
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *command_line.split()])
        caplog.set_level(logging.INFO, "__main__")
        example_logger = logging.getLogger("__main__")
        example_logger.addHandler(caplog.handler)  # the example removes it from the root logger
        try:
            runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        finally:
            example_logger.removeHandler(caplog.handler)
        return "\n".join(dict.fromkeys(record.getMessage() for record in caplog.records if record.name == "__main__"))

    return run


def test_every_example_has_a_trial():
    assert set(NAMES) == set(TRIALS)


@pytest.mark.parametrize("name", NAMES)
def test_example_is_short_and_documents_its_command(name):
    text = (EXAMPLES / f"{name}.py").read_text()
    assert len(text.splitlines()) <= LONGEST
    assert text.startswith('"""')
    assert f"\n    python examples/{name}.py" in ast.get_docstring(ast.parse(text))


@pytest.mark.parametrize("name", NAMES)
def test_example_runs_with_the_expected_results(name, run, tmp_path):
    trial = TRIALS[name]
    with ExitStack() as stack:
        if name in ONLINE:
            stack.enter_context(online(stack.enter_context(HubServer()), ALICE))
        log = run(name, trial.arguments)
    for pattern in trial.log_lines:
        assert re.search(pattern, log, re.MULTILINE), log
    for file in trial.files:
        assert (tmp_path / file).stat().st_size > 0


def test_view_of_one_image_locates_the_block(run):
    env = EnvSettings("block_picking").make()
    env.reset(seed=5)
    position = env.scene.pose(env.scene.client.getNumBodies() - 1)[0][:2]
    env.close()
    estimate = re.search(r"x = (\S+) m, y = (\S+) m", run("view_of_one_image", "--seed=5 --output={output}/views.png"))
    np.testing.assert_allclose([float(number) for number in estimate.groups()], position, atol=0.005)
