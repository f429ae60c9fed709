"""A task, a view and an encoder of another installed package, known by its entry points."""

import json
import sys
from textwrap import dedent

import pytest
from lerobot.scripts import lerobot_eval

from lerobot_symview import registry
from lerobot_symview.datasets.add_views import AddViewsConfig, add_views
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.errors import OptionError
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset
from tests.helpers.packages import install
from tests.helpers.training import train

pytestmark = pytest.mark.long

MODULE = """
    from dataclasses import dataclass

    import cv2
    import torch

    from lerobot_policy_symview.nn.encoders.base import Encoder
    from lerobot_symview import View
    from symview_sim.tasks.block_picking import BlockPicking


    class EasyPicking(BlockPicking):
        instruction = "Pick up the red block, which lies in the centre."

        def spawn(self, scene, rng):
            position = (*scene.workspace.center, 0.025)
            self._cube = scene.add_box((0.05, 0.05, 0.05), 0.1, 1.0, (0.9, 0.1, 0.1), position, rng.uniform(-0.7, 0.7))


    @dataclass(frozen=True)
    class GreyView(View):
        size: int = 76
        outputs = {"grey": "rgb"}

        def render(self, frame):
            grey = cv2.cvtColor(cv2.resize(frame.rgb, (self.size, self.size)), cv2.COLOR_RGB2GRAY)
            return {"grey": cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)}


    class MeanEncoder(Encoder):
        def __init__(self, config, group, state):
            super().__init__(group, config.width)
            self.linear = torch.nn.Linear(config.channels + len(state[0]), config.width)

        def forward(self, observation, state):
            features = self.linear(torch.cat([observation.mean(dim=(2, 3)), state], dim=1))
            return features[:, None].expand(-1, self.group.size, -1)
"""
ENTRY_POINTS = {
    "symview.tasks": {"easy_picking": "other_package:EasyPicking"},
    "symview.views": {"grey": "other_package:GreyView"},
    "symview.encoders": {"mean": "other_package:MeanEncoder"},
}


@pytest.fixture
def other_package(tmp_path, monkeypatch):
    """Install a package for as long as the test runs."""
    site = tmp_path / "site"
    install(site, "other_package", ENTRY_POINTS, monkeypatch)
    (site / "other_package.py").write_text(dedent(MODULE))
    yield
    registry.installed.cache_clear()
    sys.modules.pop("other_package", None)


@pytest.mark.usefixtures("other_package")
def test_task_view_and_encoder_of_another_package_work_end_to_end(tmp_path, monkeypatch):
    recorded, views = tmp_path / "recorded", tmp_path / "views"
    env = RecordedEnv(task="easy_picking", oracle=False)
    generate(GenerateConfig(NewDataset("test/recorded", recorded), env=env, num_episodes=2, num_workers=2))
    source = HubDataset("test/recorded", recorded)
    add_views(AddViewsConfig(source, new_repo_id="test/views", new_root=views, views=["grey"], num_workers=2))
    options = ("--policy.view=grey", "--policy.modality=rgb", "--policy.gripper_input=none", "--policy.encoder=mean")
    checkpoint = train(monkeypatch, views, tmp_path / "policy", *options)
    arguments = ["lerobot-eval", f"--policy.path={checkpoint}", "--policy.device=cpu", "--env.type=symview"]
    arguments += ["--env.task=easy_picking", "--env.max_steps=2", "--eval.n_episodes=2", "--eval.batch_size=2"]
    arguments += [f"--output_dir={tmp_path / 'eval'}"]
    monkeypatch.setattr(sys, "argv", arguments)
    lerobot_eval.main()
    assert json.loads((tmp_path / "eval" / "eval_info.json").read_text())["overall"]["n_episodes"] == 2


@pytest.mark.usefixtures("other_package")
def test_names_of_another_package_are_suggested():
    with pytest.raises(OptionError, match="did you mean 'easy_picking'"):
        RecordedEnv(task="easy_piking")
