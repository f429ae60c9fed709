"""Relative trajectories of action chunks: known answers, round trips, and equivariance."""

import math

import pytest
import torch

from lerobot_policy_symview.symmetry.groups import make_group
from lerobot_policy_symview.symmetry.representations import VectorRepresentation
from lerobot_policy_symview.symmetry.trajectories import ActionMode, Trajectories
from lerobot_policy_symview.symmetry.transforms import PlanarTransform

POSE = VectorRepresentation(("x", "y", "z", "yaw", "aperture"))
MODES: list[ActionMode] = ["delta", "absolute"]


def random_chunks(samples=4, horizon=6):
    generator = torch.Generator().manual_seed(0)
    state = torch.rand(samples, 5, generator=generator, dtype=torch.float64) - 0.5
    steps = 0.1 * torch.rand(samples, horizon, 5, generator=generator, dtype=torch.float64) - 0.05
    return state, steps


def test_increments_add_up_and_the_aperture_is_kept():
    actions = torch.tensor([[[0.01, 0, 0.02, 0.1, 1.0], [0.01, 0, -0.01, 0.2, 0.0]]])
    relative = Trajectories(POSE, POSE).relative(actions, torch.ones(1, 5))
    expected = torch.tensor([[[0.01, 0, 0.02, 0.1, 1.0], [0.02, 0, 0.01, 0.3, 0.0]]])
    torch.testing.assert_close(relative, expected)


def test_absolute_targets_are_relative_to_the_state_and_yaw_takes_the_shorter_way():
    state = torch.tensor([[0.1, -0.1, 0.2, 3.0, 1.0]])
    actions = torch.tensor([[[0.15, -0.1, 0.1, -3.0, 0.5]]])
    relative = Trajectories(POSE, POSE, "absolute").relative(actions, state)
    expected = torch.tensor([[[0.05, 0.0, -0.1, 2 * math.pi - 6.0, 0.5]]])
    torch.testing.assert_close(relative, expected)


def test_the_gripper_stays_where_it_is_after_the_end_of_an_episode():
    state, actions = random_chunks()
    is_pad = torch.arange(6).expand(4, 6) >= 3
    relative = Trajectories(POSE, POSE).relative(actions, state, is_pad)
    torch.testing.assert_close(relative[:, 3:, :4], relative[:, 2:3, :4].expand(-1, 3, -1))


@pytest.mark.parametrize("mode", MODES)
def test_round_trip(mode):
    trajectories = Trajectories(POSE, POSE, mode)
    state, actions = random_chunks()
    torch.testing.assert_close(trajectories.actions_of(trajectories.relative(actions, state), state), actions)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("element", range(8))
def test_a_transformed_scene_has_the_transformed_trajectory(mode, element):
    trajectories, group = Trajectories(POSE, POSE, mode), make_group("D4")
    state, actions = random_chunks()
    transform = PlanarTransform.of_element(group, element, state)
    moved = torch.stack([trajectories.transform(action, transform) for action in actions.unbind(1)], dim=1)
    moved_state = POSE.transform(state, transform, absolute_yaw=True)
    matrix = torch.from_numpy(POSE.matrices(group)[element])
    expected = trajectories.relative(actions, state) @ matrix.T
    torch.testing.assert_close(trajectories.relative(moved, moved_state), expected)


def test_scales_grow_with_time():
    """That of a vector is the larger one of its two dimensions, and no dimension that moves has a centre."""
    action = {
        "min": torch.tensor([-0.01, -0.02, -0.01, 0.0, 0.0]),
        "max": torch.tensor([0.01, 0.01, 0.02, 0.3, 1.0]),
        "mean": torch.tensor([0.003, 0.0, 0.0, 0.05, 0.5]),
        "std": torch.tensor([0.004, 0.002, 0.01, 0.12, 0.5]),
    }
    center, width = Trajectories(POSE, POSE).scale(action, None, horizon=16)
    assert width.shape == center.shape == (16, 5)
    torch.testing.assert_close(width[0], torch.tensor([0.005, 0.005, 0.01, 0.13, 0.5]))
    torch.testing.assert_close(width[-1], torch.tensor([0.08, 0.08, 0.16, 2.08, 0.5]))
    torch.testing.assert_close(center[3], torch.tensor([0.0, 0.0, 0.0, 0.0, 0.5]))


def test_chunks_of_increments_need_their_statistics():
    ends = {"min": -torch.ones(5), "max": torch.ones(5)}
    with pytest.raises(ValueError, match=r"chunks of actions need their mean and std, got \['max', 'min'\]"):
        Trajectories(POSE, POSE).scale(ends, None, horizon=2)


def test_trajectories_of_smooth_motions_have_the_size_of_the_noise():
    actions = torch.randn(1, 5, dtype=torch.float64) * torch.ones(8, 16, 1, dtype=torch.float64)
    stats = {"min": -torch.ones(5), "max": torch.ones(5), "mean": actions.mean((0, 1)), "std": actions.std((0, 1))}
    _, width = Trajectories(POSE, POSE).scale(stats, None, horizon=16)
    relative = Trajectories(POSE, POSE).relative(actions, torch.zeros(8, 5)) / width
    assert float(relative[..., 2].square().mean()) == pytest.approx(1, rel=1e-3)


@pytest.mark.parametrize("horizon", [1, 4])
@pytest.mark.parametrize("mode", MODES)
def test_dimensions_that_never_move_have_width_one(mode, horizon):
    ends = {"min": torch.tensor([-0.1, 0.0, 0.1, 0.0, 0.0]), "max": torch.tensor([0.1, 0.0, 0.1, 0.0, 1.0])}
    ends |= {"mean": ends["max"] / 2, "std": ends["max"] / 2}
    state = {"min": torch.tensor([0.0, 0.0, 0.1, 0.0, 0.0]), "max": torch.tensor([0.0, 0.0, 0.1, 0.0, 1.0])}
    _, width = Trajectories(POSE, POSE, mode).scale(ends, state, horizon)
    assert width.isfinite().all()
    assert (width.reshape(-1, 5)[:, 3] == 1).all()
    if mode == "absolute":
        assert (width.reshape(-1, 5)[:, 2] == 1).all()


def test_a_target_is_scaled_by_its_distance_from_the_states():
    """Targets that span 5 cm, from starts 25 cm away."""
    action = {"min": torch.tensor([0.2, 0, 0, -3.0, 0.0]), "max": torch.tensor([0.25, 0, 0, 3.0, 1.0])}
    state = {"min": torch.tensor([-0.05, 0, 0, -3.0, 0.0]), "max": torch.tensor([0.2, 0, 0, 3.0, 1.0])}
    _, width = Trajectories(POSE, POSE, "absolute").scale(action, state, horizon=2)
    torch.testing.assert_close(width[1], torch.tensor([0.3, 0.3, 1.0, math.pi, 0.5]))


def test_a_single_action_is_scaled_by_its_range():
    ends = {"min": -torch.ones(5), "max": torch.tensor([1.0, 2.0, 3.0, 1.0, 1.0])}
    for found, expected in zip(
        Trajectories(POSE, POSE).scale(ends, None, horizon=1), POSE.scale(ends["min"], ends["max"]), strict=True
    ):
        torch.testing.assert_close(found, expected)


def test_absolute_actions_need_the_pose_in_the_state():
    with pytest.raises(ValueError, match=r"action_mode=absolute needs the gripper's yaw in the declaration, got \['x"):
        Trajectories(POSE, VectorRepresentation(("x", "y", "z", "aperture")), "absolute")
    turns = VectorRepresentation(("x", "y", "z", "rx", "ry", "yaw"))
    with pytest.raises(ValueError, match="does not support rotation vectors"):
        Trajectories(turns, turns, "absolute")
