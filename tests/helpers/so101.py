"""The path of docs/own_robot.md on the simulated SO-101, from its recording to a checkpoint."""

import re
import runpy
from pathlib import Path

from lerobot.scripts import lerobot_record

from lerobot_symview.datasets.add_views import AddViewsConfig, add_views
from lerobot_symview.datasets.convert_actions import ConvertActionsConfig, convert_actions
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.datasets.robot_flags import RobotFlags

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "own_robot.md").read_text()
CAMERAS = re.search(r"^```yaml\n(# cameras.yaml\n.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)[1]
"""The calibration of the simulated camera, as the page has it."""


def load_example(name):
    """Return the names of a script of `examples`."""
    return runpy.run_path(str(ROOT / "examples" / f"{name}.py"))


def record(monkeypatch, folder, episodes=2):
    """Record demonstrations in joints, and return their folder."""
    monkeypatch.setattr(lerobot_record, "precise_sleep", lerobot_record.precise_sleep)  # which the example replaces
    load_example("so101_record")["main"]("test/joints", folder, episodes, seed=0)
    return folder


def convert(recorded):
    """Return the folder of a recording's gripper poses."""
    cameras = recorded.with_suffix(".yaml")
    cameras.write_text(CAMERAS)
    robot, target = RobotFlags(preset="so101"), recorded.with_suffix(".ee")
    return convert_actions(ConvertActionsConfig(HubDataset("test/a", recorded), robot, "", target, cameras))


def view(converted):
    """Return the folder of the views of a converted dataset."""
    source = HubDataset("test/a_ee", converted)
    return add_views(AddViewsConfig(source, new_root=converted.with_suffix(".views"), size=76, keep=[]))
