"""LeRobot's training command, in this process, for every method; its checkpoint is loaded and acts."""

import pytest
import torch
from lerobot.policies.factory import make_pre_post_processors

from lerobot_policy_symview.methods import METHODS
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_symview import keys
from symview_sim.settings import EnvSettings
from tests.helpers.training import train

pytestmark = pytest.mark.long


@pytest.mark.parametrize("method", METHODS)
def test_every_method_trains_saves_loads_and_acts(method, with_views, tmp_path, monkeypatch, capsys):
    checkpoint = train(monkeypatch, with_views, tmp_path / "policy", f"--policy.method={method}")
    policy = SymviewBcPolicy.from_pretrained(checkpoint)
    assert policy.config.method == method
    assert policy.workspace.size == 0.4
    assert float(policy.action_width[0]) == float(policy.action_width[1]) > 0
    preprocess, postprocess = make_pre_post_processors(policy.config, str(checkpoint))
    env = EnvSettings("block_picking", oracle=method == "oracle_equi").make()
    observation, _ = env.reset(seed=7)
    env.close()
    batch = {keys.STATE: torch.from_numpy(observation["agent_pos"])[None]}
    for name, image in observation["pixels"].items():
        batch[keys.rgb(name)] = torch.from_numpy(image).permute(2, 0, 1)[None] / 255
    for name, value in observation.items():
        if name.startswith(("images.", "camera.")):
            batch[f"observation.{name}"] = torch.from_numpy(value)[None]
    action = postprocess(policy.select_action(preprocess(batch)))
    assert action.shape == (1, 5)
    assert torch.isfinite(action).all()


def test_wrong_declaration_raises_before_training(with_views, tmp_path, monkeypatch):
    with pytest.raises(
        ValueError, match=r"--policy.action_symmetry describes 3 dimensions.*'action' has 5 \(dx, dy, dz"
    ):
        train(monkeypatch, with_views, tmp_path / "policy", "--policy.action_symmetry=[x, y, z]")
