"""Sizes declared in files are checked before memory is allocated."""

import json
import struct

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from safetensors import SafetensorError

from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_workspace
from lerobot_symview.datasets.source import SourceDataset
from lerobot_symview.errors import CalibrationError, OptionError, SymviewError
from lerobot_symview.runtime.flag_errors import FlagError
from lerobot_symview.views import VIEWS, make_view
from symview_eval.contact_sheet import TILE, with_outline
from tests.helpers.cameras import make_camera
from tests.helpers.policies import make_config
from tests.malicious.files import (
    DATA,
    DEPTH,
    EPISODES,
    RGB,
    both_commands,
    change_columns,
    change_feature,
    change_image,
    derive,
    encoded,
    make_video_feature,
    png_of,
    saved_replay,
    show,
    tiff_of,
)


@both_commands
@pytest.mark.parametrize(
    ("key", "data", "size"),
    [
        (RGB, png_of(30_000, 20_000), "30000 x 20000"),
        (RGB, encoded(".png", np.zeros((300, 290, 3), np.uint8)), "300 x 290"),
        (RGB, encoded(".jpg", np.zeros((300, 290, 3), np.uint8)), "300 x 290"),
        (DEPTH, tiff_of(9_000, 8_000), "9000 x 8000"),
        (DEPTH, encoded(".tiff", np.ones((300, 290), np.float32)), "300 x 290"),
    ],
)
def test_images_must_have_the_declared_size(dataset, tmp_path, command, key, data, size):
    change_image(dataset, key, data)
    with pytest.raises(ValueError, match=f"{size}.*152 x 152"):
        command(dataset, tmp_path)


def test_an_empty_image_is_refused(dataset, tmp_path):
    change_image(dataset, RGB, b"")
    with pytest.raises(ValueError, match="no image"):
        show(dataset, tmp_path)


def write_video(dataset, height, width, frames):
    make_video_feature(dataset)
    file = dataset / "videos" / RGB / "chunk-000" / "file-000.mp4"
    file.parent.mkdir(parents=True)
    with av.open(str(file), "w") as container:
        stream = container.add_stream("mpeg4", rate=4, width=width, height=height, pix_fmt="yuv420p")
        for _ in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((height, width, 3), np.uint8))))
        container.mux(stream.encode())


def test_videos_must_have_the_declared_size(dataset, tmp_path):
    write_video(dataset, 304, 320, frames=16)
    with pytest.raises(ValueError, match=r"304 x 320.*152 x 152"):
        show(dataset, tmp_path)


def test_distant_video_frames_are_refused(dataset, tmp_path):
    """Decoding covers the whole range from the first to the last requested timestamp."""
    write_video(dataset, 152, 152, frames=400)
    timestamps = pq.read_table(dataset / DATA)["timestamp"].to_numpy() * 50
    change_columns(dataset / DATA, timestamp=pa.array(timestamps, pa.float32()))
    with pytest.raises(SymviewError, match="video frames, expected less than"):
        derive(dataset, tmp_path)


def test_symmetry_declarations_have_a_maximum_length():
    with pytest.raises(FlagError, match=r"--policy\.state_symmetry has 100000 dimensions"):
        SymviewBcConfig(device="cpu", gripper_input="vector", state_symmetry=["scalar"] * 10**5)


@pytest.mark.parametrize(
    "shape", [[10**9, 10**9, 3], [20_000, 20_000, 3], [-8, 8, 3], [0, 8, 3], [152, 152], [152.5, 152, 3], "huge", None]
)
def test_invalid_image_shapes_are_refused(dataset, shape):
    change_feature(dataset, RGB, shape=shape)
    with pytest.raises(SymviewError, match=f"{RGB}.*shape"):
        SourceDataset(dataset)


def test_more_episodes_than_declared_are_refused(dataset):
    """Equal rows compress to almost nothing."""
    table = pq.read_table(dataset / EPISODES)
    pq.write_table(table.take(pa.array(np.zeros(20_000, int))), dataset / EPISODES, compression="zstd")
    with pytest.raises(SymviewError, match=r"20000.*total_episodes"):
        len(SourceDataset(dataset).episodes)


@both_commands
@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("length", 10**12),
        ("length", -5),
        ("length", 0),
        ("length", "many"),
        ("dataset_from_index", 10**15),
        ("dataset_from_index", -3),
        ("episode_index", 9),
    ],
)
def test_invalid_episode_ranges_are_refused(dataset, tmp_path, command, column, value):
    values = pq.read_table(dataset / EPISODES)[column].to_pylist()
    change_columns(dataset / EPISODES, **{column: pa.array([*map(type(value), values[:-1]), value])})
    with pytest.raises(SymviewError, match=column):
        command(dataset, tmp_path)


@both_commands
def test_rows_larger_than_declared_are_refused(dataset, tmp_path, command):
    """A table of a few kilobytes decompresses to 64 MiB of zeros."""
    change_image(dataset, RGB, bytes(2**26))
    with pytest.raises(SymviewError, match=r"file-000\.parquet.*bytes"):
        command(dataset, tmp_path)


@pytest.mark.parametrize("view", list(VIEWS))
def test_huge_views_are_refused(view):
    with pytest.raises(OptionError, match="size must"):
        make_view(view, size=10**6)


@pytest.mark.parametrize(
    "facts",
    [
        {"options": {"size": 10**6}},
        {"options": {"size": 76, "command": "rm"}},
        {"options": "size"},
        {"workspace": {"size": float("nan")}},
        {"workspace": "here"},
    ],
)
def test_a_policy_refuses_invalid_view_options_of_a_dataset(with_views, facts):
    features = json.loads((with_views / "meta" / "info.json").read_text())["features"]
    features[keys.view("side", "reproj")]["info"]["symview"] |= facts
    with pytest.raises(ValueError, match=keys.view("side", "reproj")):
        make_config().set_dataset_feature_metadata(features)


@both_commands
@pytest.mark.parametrize("workspace", [{"size": 1e400}, {"size": 0.4, "command": "rm"}, {"center": "ab"}, "here"])
def test_an_invalid_workspace_in_a_dataset_is_refused(dataset, tmp_path, command, workspace):
    change_feature(dataset, RGB, info={"symview": {"workspace": workspace}})
    with pytest.raises(ValueError, match="workspace"):
        command(dataset, tmp_path)


@pytest.mark.parametrize("entries", [{"size": float("nan")}, {"height_limit": 1e400}, {"center": [float("nan"), 0]}])
def test_an_infinite_workspace_is_refused(entries):
    with pytest.raises(CalibrationError, match="finite"):
        parse_workspace(entries)


def test_huge_networks_are_refused():
    with pytest.raises(FlagError, match=r"--policy\.width"):
        SymviewBcConfig(device="cpu", width=16 * 10**5)


def test_arrays_larger_than_their_files_are_refused(checkpoint, tmp_path):
    shape = [10**12]
    header = json.dumps({"x": {"dtype": "F32", "shape": shape, "data_offsets": [0, 4 * shape[0]]}}).encode()
    (checkpoint / "model.safetensors").write_bytes(struct.pack("<Q", len(header)) + header)
    with pytest.raises(SafetensorError, match="not fully covered"):
        SymviewBcPolicy.from_pretrained(checkpoint)
    replay = saved_replay(tmp_path / "replay")
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({shape[0]}, 2), }}".ljust(117).encode() + b"\n"
    (tmp_path / "replay" / "image.npy").write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + header + bytes(8))
    with pytest.raises(ValueError, match="greater than file size"):
        replay.load(tmp_path / "replay")


def test_the_enlargement_of_a_narrow_image_is_limited(workspace):
    camera = make_camera(size=152)
    image = with_outline(np.zeros((1, 400, 3), np.uint8), camera, workspace)
    assert max(image.shape) <= 4 * TILE
