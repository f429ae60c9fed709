"""Helpers that turn valid datasets and policies into malicious or malformed ones."""

import json
import struct
import zlib

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.policies.factory import make_pre_post_processors

from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.rl.replay import Replay, ReplayConfig
from lerobot_symview import keys
from lerobot_symview.datasets.add_views import add_views
from lerobot_symview.runtime.cli import DatasetLocation
from symview_eval.preview import PreviewConfig, preview
from tests.helpers.datasets import views_config

DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
RGB, DEPTH = keys.rgb("side"), keys.depth("side")


def derive(dataset, folder):
    return add_views(views_config(dataset, folder / "results" / "inner" / "views", views=["reproj"], size=32))


def show(dataset, folder):
    target = DatasetLocation("test/malicious", dataset)
    return preview(PreviewConfig(target, output_dir=folder / "preview", frames=1, rerun=False))


both_commands = pytest.mark.parametrize("command", [derive, show])


def change_json(file, **entries):
    file.write_text(json.dumps(json.loads(file.read_text()) | entries))


def change_info(dataset, **entries):
    change_json(dataset / "meta" / "info.json", **entries)


def change_feature(dataset, key, **entries):
    features = json.loads((dataset / "meta" / "info.json").read_text())["features"]
    change_info(dataset, features=features | {key: features.get(key, {}) | entries})


def change_columns(file, **columns):
    table = pq.read_table(file)
    for name, values in columns.items():
        table = table.drop_columns([name]) if name in table.column_names else table
        table = table.append_column(name, values if isinstance(values, pa.Array) else pa.array([values] * len(table)))
    pq.write_table(table, file, compression="zstd")


def change_image(dataset, key, encoded, path="image.png"):
    """Replace the first image of a feature."""
    table = pq.read_table(dataset / DATA)
    cells = table[key].to_pylist()
    cells[0] = {"bytes": encoded, "path": str(path)}
    field = table.schema.field(key)
    table = table.set_column(table.column_names.index(key), field, pa.array(cells, field.type))
    pq.write_table(table, dataset / DATA, compression="zstd")


def make_video_feature(dataset, video_path="videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"):
    """Declare the camera's colour images as a video feature."""
    change_feature(dataset, RGB, dtype="video")
    change_info(dataset, video_path=video_path)
    location = {"chunk_index": 0, "file_index": 0, "from_timestamp": 0.0}
    change_columns(dataset / EPISODES, **{f"videos/{RGB}/{name}": value for name, value in location.items()})


def png_of(height, width):
    """Return the header of a PNG file that declares `height` x `width` pixels, without any pixel data."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))


def tiff_of(height, width):
    """Return the header of a float32 TIFF file that declares `height` x `width` pixels, without any pixel data."""
    tags = {256: width, 257: height, 258: 32, 259: 1, 262: 1, 273: 8, 277: 1, 278: height, 279: 4, 339: 3}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(8)


def encoded(extension, image):
    return cv2.imencode(extension, image)[1].tobytes()


def saved_replay(folder):
    frame = {"image": np.zeros(2, np.uint8)}
    replay = Replay(ReplayConfig(), frame, 2, [2, 2], folder)
    replay.start_episode(0, frame)
    replay.add_transition(0, np.zeros(2, np.float32), 0.0, True, None)
    replay.save(folder)
    return replay


def load_with_processors(folder):
    """Load a policy and its processors in the order of LeRobot's commands."""
    policy = SymviewBcPolicy.from_pretrained(folder)
    return make_pre_post_processors(policy.config, str(folder))
