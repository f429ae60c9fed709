"""Samples of histories and chunks: those of LeRobot's dataset, for our policies and LeRobot's own."""

from dataclasses import replace

import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.factory import resolve_delta_timestamps
from torch.utils.data import default_collate

from lerobot_policy_symview.inputs.history import as_frames, as_history, history_length
from lerobot_policy_symview.inputs.observation_codec import ObservationCodec
from lerobot_policy_symview.rl.demonstrations import open_dataset
from lerobot_symview import keys
from symview_eval.experiments.actors import make_actor
from symview_eval.experiments.demonstrations import Demonstrations
from symview_eval.experiments.grid import select
from symview_eval.experiments.scale import SCALES
from symview_eval.experiments.tables import EXPERIMENTS
from symview_sim.settings import NewDataset

ROWS = ["flow_reproj_equi", "regression_reproj_equi", "act_sideview", "diffusion_reproj"]


def smoke_cell(row, **settings):
    """Return a row's cell; `settings` override the policy's."""
    (cell,) = select(EXPERIMENTS["chunks"], SCALES["smoke"], ["block_picking"], [row])
    changed = replace(cell.chunks, policy=cell.chunks.policy | settings)
    return replace(cell, scale=replace(cell.scale, chunks={cell.row.chunks: changed}))


def dataset_and_actor(folder, row, **settings):
    dataset = open_dataset(NewDataset("test/recorded", folder))
    return dataset, make_actor(smoke_cell(row, **settings), dataset, "cpu")


def loaded_batch(dataset, actor, chosen):
    """Return what LeRobot's loader delivers, through the preprocessor and the compact storage."""
    config, codec = actor.policy.config, ObservationCodec(actor.scene)
    timestamps = resolve_delta_timestamps(config, dataset.meta)
    loaded = LeRobotDataset(
        dataset.repo_id, dataset.root, delta_timestamps=timestamps, depth_output_unit="m", video_backend="pyav"
    )
    batch = default_collate([loaded[int(index)] for index in chosen])
    observed = {key: batch[key] for key in dataset.meta.features if key.startswith("observation.")}
    length = history_length(observed)
    packed = codec.pack(actor.see(observed if length is None else as_frames(observed)))
    stacked = {name: torch.stack([torch.from_numpy(frame[name]) for frame in packed]) for name in packed[0]}
    frames = codec.unpack(stacked, torch.device("cpu"))
    history = frames if length is None else as_history(frames, length)
    return actor.finish(history | {name: batch[name] for name in (keys.ACTION, "action_is_pad")})


@pytest.mark.parametrize("row", ROWS)
def test_samples_are_those_of_lerobots_dataset(row, recorded):
    dataset, actor = dataset_and_actor(recorded, row)
    chosen = torch.arange(len(dataset))  # the starts and ends of all episodes among them
    samples, expected = Demonstrations(dataset, actor).samples(chosen), loaded_batch(dataset, actor, chosen)
    names = {*actor.scene.keys, keys.ACTION, "action_is_pad"}
    for name in names:
        assert torch.equal(samples[name], expected[name]), name
    assert samples["action_is_pad"].any(dim=1).sum() >= 2 * dataset.num_episodes
    assert not samples["action_is_pad"].all(dim=1).any()


def test_preprocessing_frames_alone_is_that_of_histories(recorded):
    dataset, actor = dataset_and_actor(recorded, "flow_reproj_equi")
    samples = Demonstrations(dataset, actor).samples(torch.arange(4))
    timestamps = resolve_delta_timestamps(actor.policy.config, dataset.meta)
    loaded = LeRobotDataset(
        dataset.repo_id, dataset.root, delta_timestamps=timestamps, depth_output_unit="m", video_backend="pyav"
    )
    batch = actor.preprocessor(default_collate([loaded[index] for index in range(4)]))
    color = actor.policy.config.color_key
    assert samples[color].shape[1] == 2
    assert torch.equal(samples[color], batch[color])
    assert torch.equal(samples[keys.STATE], batch[keys.STATE])
    assert torch.equal(samples[keys.STATE][0, 0], samples[keys.STATE][0, 1])  # the first observation is repeated


@pytest.mark.parametrize("dropped", [0, 3])
def test_a_pass_visits_every_sample_that_is_not_dropped_once(dropped, recorded):
    dataset, actor = dataset_and_actor(recorded, "flow_sideview_equi", drop_n_last_frames=dropped)
    ends = {episode["dataset_to_index"] for episode in dataset.meta.episodes}
    late = {end - number for end in ends for number in range(1, dropped + 1)}
    demonstrations, visited = Demonstrations(dataset, actor), []
    demonstrations.samples = lambda chosen: visited.extend(chosen.tolist())
    count = len(dataset) - len(late)
    assert len(late) == dropped * dataset.num_episodes
    batches = demonstrations.batches(1, seed=0)
    for _ in range(count):
        next(batches)
    assert sorted(visited) == sorted(set(range(len(dataset))) - late)
