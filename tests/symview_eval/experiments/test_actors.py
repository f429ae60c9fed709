"""Policies of cells, ours and LeRobot's own: their checkpoints act as they did."""

import pytest
import torch

from lerobot_policy_symview.rl.rollouts import simulator_config
from lerobot_symview import keys
from symview_eval.experiments.actors import ForeignActor, is_ours, load_actor, save_actor
from symview_sim.settings import EnvSettings
from symview_sim.simulators import Reset, Simulators

from .test_demonstrations import dataset_and_actor, smoke_cell


def actions_of(actor, observations):
    actor.start_episodes(0)
    return torch.from_numpy(actor(observations))


@pytest.mark.parametrize("row", ["flow_reproj_equi", "act_reproj", "diffusion_sideview"])
def test_a_copy_and_a_checkpoint_act_as_the_policy(row, recorded, tmp_path):
    cell, (_, actor) = smoke_cell(row), dataset_and_actor(recorded, row)
    assert isinstance(actor, ForeignActor) != is_ours(cell)
    with torch.no_grad():
        for parameter in actor.policy.parameters():  # untrained, some policies do not move at all
            parameter.add_(0.02 * torch.randn_like(parameter))
    save_actor(actor, tmp_path)
    with Simulators(simulator_config(actor.scene.config, EnvSettings("block_picking")), 1) as simulators:
        simulators.send(0, Reset(0))
        observation = simulators.receive(0).observation
    assert set(observation) == set(actor.scene.keys)
    actions = actions_of(actor, [observation, observation])
    copy = actor.copy()
    with torch.no_grad():
        for parameter in actor.policy.parameters():
            parameter.zero_()
    assert not torch.allclose(actions_of(actor, [observation, observation]), actions)
    assert torch.allclose(actions_of(copy, [observation, observation]), actions)
    assert torch.allclose(actions_of(load_actor(cell, tmp_path), [observation, observation]), actions)


@pytest.mark.parametrize("row", ["act_sideview", "diffusion_reproj"])
def test_lerobots_policies_see_small_images_and_normalised_states(row, recorded):
    dataset, actor = dataset_and_actor(recorded, row)
    image = actor.policy.config.image_features
    assert list(image) == [actor.scene.config.color_key]
    assert next(iter(image.values())).shape == (3, 76, 76)
    stats = dataset.meta.stats[keys.ACTION]
    low = actor.finish({keys.STATE: torch.zeros(1, 5), keys.ACTION: torch.as_tensor(stats["min"])[None]})[keys.ACTION]
    assert (low < -0.5).any()
    assert torch.allclose(actor.postprocessor(low), torch.as_tensor(stats["min"]), atol=1e-6)
