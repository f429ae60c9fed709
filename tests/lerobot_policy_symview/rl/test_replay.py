"""Contents and sampling probabilities of the prioritised replay buffer."""

import numpy as np
import pytest
import torch

from lerobot_policy_symview.rl.replay import Replay, ReplayConfig

DEMONSTRATIONS, FIRST, SECOND = range(3)


def frame(number):
    return {
        "image": np.full((3, 4, 4), number % 256, np.uint8),
        "state": np.array([number, -number], np.float32),
    }


def make_replay(folder, lengths=(10, 4, 4), **options):
    return Replay(ReplayConfig(**options), frame(0), 2, lengths, folder)


def add_episode(replay, stream, numbers, terminal=True):
    """Add an episode of numbered frames; the action at a frame is its number, the reward half of it."""
    replay.start_episode(stream, frame(numbers[0]))
    for i, number in enumerate(numbers):
        is_last = i == len(numbers) - 1
        if is_last and not terminal:
            return
        action = np.array([number, 0], np.float32)
        replay.add_transition(stream, action, number / 2, is_last, None if is_last else frame(numbers[i + 1]))


def transitions(replay):
    """Return every transition that can be sampled: (frame number, next frame number, reward, terminal)."""
    sampled = set()
    rng = np.random.default_rng(0)
    for _ in range(30):
        sample = replay.sample(64, 0.4, rng)
        before, after = sample.frames["state"][:, 0].chunk(2)
        assert torch.equal(sample.frames["image"][:, 0, 0, 0].float(), sample.frames["state"][:, 0] % 256)
        assert torch.equal(sample.action[:, 0], before)
        rows = zip(before.tolist(), after.tolist(), sample.reward.tolist(), sample.terminal.tolist(), strict=True)
        sampled |= set(rows)
    return sampled


def test_the_next_frame_of_a_transition_is_from_the_same_stream(tmp_path):
    replay = make_replay(tmp_path)
    add_episode(replay, DEMONSTRATIONS, [1, 2, 3])
    add_episode(replay, FIRST, [11, 12, 13], terminal=False)
    add_episode(replay, SECOND, [21])
    assert len(replay) == 6
    assert transitions(replay) == {
        (1, 2, 0.5, False), (2, 3, 1.0, False), (3, 3, 1.5, True), (11, 12, 5.5, False), (12, 13, 6.0, False),
        (21, 21, 10.5, True),
    }  # fmt: skip


def test_a_full_stream_overwrites_its_own_oldest_transition(tmp_path):
    replay = make_replay(tmp_path)
    add_episode(replay, DEMONSTRATIONS, [1, 2])
    add_episode(replay, SECOND, [21, 22])
    add_episode(replay, FIRST, list(range(11, 17)), terminal=False)  # 16 overwrites 12
    kept = {(before, after) for before, after, _, _ in transitions(replay)}
    assert kept == {(1, 2), (2, 2), (21, 22), (22, 22), (13, 14), (14, 15), (15, 16)}


def test_the_last_transition_of_a_lost_episode_has_its_next_frame(tmp_path):
    replay = make_replay(tmp_path)
    add_episode(replay, FIRST, [11, 12], terminal=False)
    add_episode(replay, FIRST, [13, 14], terminal=False)
    assert {(before, after) for before, after, _, _ in transitions(replay)} == {(11, 12), (13, 14)}


def test_only_terminal_transitions_lack_a_next_frame(tmp_path):
    replay = make_replay(tmp_path)
    replay.start_episode(FIRST, frame(1))
    for terminal, next_frame in ((True, frame(2)), (False, None)):
        with pytest.raises(ValueError, match="needs a next frame unless it is terminal"):
            replay.add_transition(FIRST, np.zeros(2, np.float32), 0.0, terminal, next_frame)


def test_sampling_probabilities_and_weights_follow_schaul_et_al(tmp_path):
    """Equation 1 and the importance-sampling weights of Schaul et al. (2015), from a large sample."""
    replay = make_replay(tmp_path, alpha=0.6, epsilon=0.01, demo_priority_bonus=0.5)
    add_episode(replay, DEMONSTRATIONS, [0])
    add_episode(replay, FIRST, [1, 2, 3])
    slots = replay.sample(64, 0.4, np.random.default_rng(0))
    by_number = dict(zip(slots.action[:, 0].int().tolist(), slots.slots.tolist(), strict=True))
    errors = np.array([0.3, 0.0, 1.0, 4.0])
    replay.update_priorities(np.array([by_number[number] for number in range(4)]), errors)
    priority = errors + 0.01 + np.array([0.5, 0, 0, 0])
    probability = priority**0.6 / (priority**0.6).sum()

    sample = replay.sample(20_000, 0.7, np.random.default_rng(1))
    numbers = sample.action[:, 0].long()
    np.testing.assert_allclose(np.bincount(numbers, minlength=4) / 20_000, probability, atol=1e-3)
    weight = (4 * probability) ** -0.7
    torch.testing.assert_close(sample.weight, torch.tensor(weight / weight.max(), dtype=torch.float32)[numbers])
    assert torch.equal(sample.is_demo, numbers == 0)


def test_new_transitions_get_the_maximal_priority(tmp_path):
    replay = make_replay(tmp_path, demo_priority_bonus=0.0)
    add_episode(replay, FIRST, [1])
    replay.update_priorities(np.array([10]), np.array([7.0]))
    add_episode(replay, SECOND, [2])
    numbers = replay.sample(1000, 0.4, np.random.default_rng(0)).action[:, 0]
    assert 490 < (numbers == 2).sum() < 510


@pytest.mark.parametrize("limit", [8.0, 0.0], ids=["memory", "disk"])
def test_a_loaded_replay_samples_the_same_transitions(tmp_path, limit):
    replay = make_replay(tmp_path / "one", memory_limit_gb=limit)
    assert replay.is_on_disk == (limit == 0.0)
    add_episode(replay, DEMONSTRATIONS, [1, 2, 3])
    add_episode(replay, FIRST, list(range(11, 17)), terminal=False)
    add_episode(replay, SECOND, [21])
    replay.update_priorities(np.array([0, 1]), np.array([3.0, 0.1]))
    replay.save(tmp_path / "saved")
    loaded = make_replay(tmp_path / "two", memory_limit_gb=limit)
    loaded.load(tmp_path / "saved")
    for buffer in (replay, loaded):
        add_episode(buffer, SECOND, [22, 23, 24])
    samples = [buffer.sample(64, 0.5, np.random.default_rng(3)) for buffer in (replay, loaded)]
    for name, value in vars(samples[0]).items():
        other = getattr(samples[1], name)
        if isinstance(value, dict):
            assert all(torch.equal(value[key], other[key]) for key in value)
        else:
            assert np.array_equal(value, other)


def test_memory_per_transition(tmp_path):
    """The paper's frames: 25,000 transitions of 152 x 152 RGBD take less than 3 GB."""
    images = {"rgb": np.zeros((3, 152, 152), np.uint8), "height": np.zeros((1, 152, 152), np.float16)}
    replay = Replay(ReplayConfig(), images | {"state": np.zeros(5, np.float32)}, 5, [140, *[5102] * 5], tmp_path)
    assert replay.bytes_per_transition == 152 * 152 * 5 + 20 + 20 + 4 + 1 + 8
    assert 25_000 * 51 / 50 * replay.bytes_per_transition < 3e9


@pytest.mark.parametrize(
    "options",
    [{"alpha": 1.1}, {"beta": -0.1}, {"epsilon": 0.0}, {"demo_priority_bonus": -1.0}, {"capacity": 0}],
    ids=str,
)
def test_errors_name_the_invalid_option(options):
    with pytest.raises(ValueError, match=f"--replay.{next(iter(options))}"):
        ReplayConfig(**options)
