"""The registry of tasks: built-in, registered in this process, and added by installed packages."""

import subprocess
import sys
from textwrap import dedent

import gymnasium
import pytest

from lerobot_symview import registry
from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.placement import CameraSpec
from symview_sim import TASK_NAMES, gym_id
from symview_sim.settings import EnvSettings
from symview_sim.tasks import TASKS, make_task, register_task
from symview_sim.tasks.block_picking import BlockPicking
from tests.helpers.packages import install

SMALL = CameraSpec(height=16, width=16)
PACKAGE = """
    from symview_sim.tasks.block_picking import BlockPicking


    class GentlePicking(BlockPicking):
        instruction = "Pick up the red block gently."
"""


@pytest.fixture
def wide_picking():
    """A task registered as long as the test runs."""

    @register_task("wide_picking")
    class WidePicking(BlockPicking):
        instruction = "Pick up the red block, wherever it is."

    yield WidePicking
    TASKS.unregister("wide_picking")


def test_the_built_in_tasks_are_sorted_and_named_after_their_modules():
    assert TASK_NAMES == tuple(sorted(TASK_NAMES)) == TASKS.builtin
    assert len(TASK_NAMES) == 6
    for name in TASK_NAMES:
        assert type(make_task(name)).__module__ == f"symview_sim.tasks.{name}"


def test_a_registered_task_is_simulated_in_the_same_process(wide_picking):
    env = EnvSettings("wide_picking", camera=SMALL).make()
    assert env.task_description == wide_picking.instruction
    done = False
    env.reset(seed=0)
    while not done:
        _, reward, terminated, truncated, _ = env.step(env.expert_action())
        done = terminated or truncated
    env.close()
    assert reward == 1.0


def test_gymnasium_makes_a_registered_task(wide_picking):
    env = gymnasium.make(gym_id("block_picking"), task="wide_picking", camera=SMALL)
    assert env.unwrapped.task_description == wide_picking.instruction


def test_a_registered_name_is_suggested_and_cannot_be_taken_twice(wide_picking):
    with pytest.raises(OptionError, match="did you mean 'wide_picking'"):
        EnvSettings("wide_piking")
    with pytest.raises(ValueError, match="a task named 'wide_picking' is already registered"):
        register_task("wide_picking")
    with pytest.raises(ValueError, match="a task named 'block_picking' is already registered"):
        register_task("block_picking")


def test_an_unregistered_task_is_unknown():
    with pytest.raises(ValueError, match=r"unknown task 'wide_picking', expected one of: block_in_bowl, .*drawer"):
        make_task("wide_picking")


def test_the_task_of_an_installed_package_is_simulated_in_any_process(tmp_path, monkeypatch):
    install(tmp_path, "gentle_tasks", {"symview.tasks": {"gentle_picking": "gentle_tasks:GentlePicking"}}, monkeypatch)
    (tmp_path / "gentle_tasks.py").write_text(dedent(PACKAGE))
    code = f"""
        import sys
        sys.path.append({str(tmp_path)!r})
        from symview_sim.settings import EnvSettings
        print(EnvSettings("gentle_picking").make().task_description)
    """
    try:
        assert EnvSettings("gentle_picking", camera=SMALL).make().task_description == "Pick up the red block gently."
        other = subprocess.run([sys.executable, "-c", dedent(code)], check=True, capture_output=True, text=True)
        assert other.stdout == "Pick up the red block gently.\n"
    finally:
        registry.installed.cache_clear()
        sys.modules.pop("gentle_tasks", None)
