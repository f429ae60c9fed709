"""Configurations of `add_views`, contents of folders, and recorded and modified datasets."""

import json
from contextlib import contextmanager

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset

from lerobot_symview import keys
from lerobot_symview.datasets import derivation
from lerobot_symview.datasets.add_views import AddViewsConfig
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.datasets.image_codec import decode_depth, encode_metres
from tests.conftest import VIEW_SIZE


def views_config(source, target, **options):
    defaults = {"new_repo_id": "test/derived", "new_root": target, "views": ["reproj", "persp"], "size": VIEW_SIZE}
    return AddViewsConfig(HubDataset("test/recorded", source), **(defaults | options))


def contents(folder):
    return {file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@contextmanager
def interrupted_at_the_second_part(monkeypatch):
    """Expect that a derived dataset is written, which ends as by Ctrl-C once one part is there."""
    written, write_part = [], derivation.write_part

    def fail_at_the_second(config, part):
        if written:
            raise KeyboardInterrupt
        written.append(part)
        return write_part(config, part)

    with monkeypatch.context() as patched:
        patched.setattr(derivation, "write_part", fail_at_the_second)
        with pytest.raises(KeyboardInterrupt):
            yield


def images_of(folder, key):
    dataset = LeRobotDataset("test/images", root=folder, depth_output_unit="m", video_backend="pyav")
    return np.stack([dataset[i][key].numpy() for i in range(len(dataset))])


def change_feature(folder, key, **entries):
    """Change a dataset's declaration of a feature."""
    file = folder / "meta" / "info.json"
    info = json.loads(file.read_text())
    info["features"][key] = info["features"].get(key, {}) | entries
    file.write_text(json.dumps(info))


def rewrite_depth(folder, key, change):
    """Replace the depth images (H, W) of a feature."""
    for file in sorted((folder / "data").rglob("*.parquet")):
        table = pq.read_table(file)
        cells = [
            cell | {"bytes": encode_metres(change(decode_depth(cell["bytes"])))} for cell in table[key].to_pylist()
        ]
        column = table.schema.get_field_index(key)
        changed = pa.array(cells, table.field(column).type)
        pq.write_table(table.set_column(column, table.field(column), changed), file)


def in_mm(depth, unit=0.001):
    """Depth in metres as a camera stores it: uint16, by default millimetres."""
    return np.rint(depth / unit).astype(np.uint16)


def record_real_robot(folder, rgb, depth, use_videos=False, episodes=1, depth_video=False, **depth_info):
    """Record episodes of three frames of a robot with joint angles and an RGBD camera `front` without calibration."""
    joints = {"dtype": "float32", "shape": (6,), "names": [f"joint_{i}" for i in range(6)]}
    axes = ["height", "width", "channels"]
    dataset = LeRobotDataset.create(
        "test/real",
        fps=10,
        root=folder,
        use_videos=use_videos or depth_video,
        features={
            keys.STATE: joints,
            keys.ACTION: joints,
            keys.rgb("front"): {"dtype": "video" if use_videos else "image", "shape": rgb.shape, "names": axes},
            keys.depth("front"): {
                "dtype": "video" if depth_video else "image",
                "shape": (*depth.shape, 1),
                "names": axes,
                "info": {"is_depth_map": True} | depth_info,
            },
        },
    )
    rng = np.random.default_rng(0)
    images = {keys.rgb("front"): rgb, keys.depth("front"): depth[..., None]}
    for _ in range(episodes):
        for _ in range(3):
            angles = rng.normal(size=6).astype(np.float32)
            dataset.add_frame(images | {keys.STATE: angles, keys.ACTION: angles, "task": "none"})
        dataset.save_episode()
    dataset.finalize()
