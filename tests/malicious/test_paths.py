"""Paths in a dataset's metadata must stay inside its folder."""

import numpy as np
import pytest

from lerobot_policy_symview.rl.demonstrations import open_dataset
from lerobot_symview.errors import SymviewError
from lerobot_symview.runtime.cli import DatasetLocation
from tests.malicious.files import (
    DATA,
    EPISODES,
    RGB,
    both_commands,
    change_columns,
    change_feature,
    change_image,
    change_info,
    derive,
    encoded,
    make_video_feature,
)

TEMPLATES = [
    "../private/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "data/../../private/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "PRIVATE/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "data/chunk-{chunk_index.__class__}/file-{file_index:03d}.parquet",
    "data/chunk-{chunk_index!r}/file-{file_index:03d}.parquet",
    "data/chunk-{chunk_index:0300000d}/file-{file_index:03d}.parquet",
    "data/chunk-{0}/file-{file_index:03d}.parquet",
    "data/chunk-{somewhere}/file-{file_index:03d}.parquet",
    "data/chunk-{chunk_index:03d",
    "",
    None,
    ["data"],
]


@both_commands
@pytest.mark.parametrize("template", TEMPLATES)
def test_tables_must_be_inside_the_dataset(dataset, outside, tmp_path, command, template):
    data_path = template.replace("PRIVATE", str(outside)) if isinstance(template, str) else template
    change_info(dataset, data_path=data_path)
    with pytest.raises(SymviewError, match="data_path"):
        command(dataset, tmp_path)


@both_commands
@pytest.mark.parametrize("template", [*TEMPLATES[:-3], "videos/{video_key.__class__}/{video_key}.mp4"])
def test_videos_must_be_inside_the_dataset(dataset, outside, tmp_path, command, template):
    make_video_feature(dataset, template.replace("PRIVATE", str(outside)))
    with pytest.raises(SymviewError, match="video_path"):
        command(dataset, tmp_path)


def test_a_template_must_not_lead_outside_the_derived_dataset(dataset, tmp_path):
    """The template gives 77/77 in the source, and ../.. in the derived dataset, whose files are numbered from 0."""
    folder = "{file_index!s:.>2.{chunk_index}s}"
    change_info(dataset, data_path=f"{folder}/{folder}/stray{{file_index}}.parquet")
    change_columns(dataset / EPISODES, **{"data/chunk_index": 2, "data/file_index": 77})
    (dataset / "77" / "77").mkdir(parents=True)
    (dataset / DATA).rename(dataset / "77" / "77" / "stray77.parquet")
    with pytest.raises(SymviewError, match="data_path"):
        derive(dataset, tmp_path)
    assert not list(tmp_path.rglob("stray0.parquet"))


@both_commands
@pytest.mark.parametrize("chunk_index", ["../../private/chunk-000", -1, 0.5, None])
def test_chunk_indices_must_be_counts(dataset, outside, tmp_path, command, chunk_index):
    change_info(dataset, data_path="data/{chunk_index}/file-{file_index:03d}.parquet")
    change_columns(dataset / EPISODES, **{"data/chunk_index": chunk_index})
    with pytest.raises(SymviewError, match="chunk_index"):
        command(dataset, tmp_path)


@both_commands
@pytest.mark.parametrize("name", ["../../../download/private", "../../private", "PRIVATE", "..", "", "a/b", "a\0b"])
def test_feature_names_must_not_be_paths(dataset, outside, tmp_path, command, name):
    """A feature's videos are copied from and to a folder with the feature's name."""
    (dataset / "videos").mkdir()
    video = {"dtype": "video", "shape": [8, 8, 3], "names": ["height", "width", "channels"], "info": {}}
    change_feature(dataset, name.replace("PRIVATE", str(outside)), **video)
    with pytest.raises(SymviewError, match=r"info\.json: the feature"):
        command(dataset, tmp_path)
    assert list(tmp_path.rglob("secret.txt")) == [outside / "secret.txt"]


@both_commands
def test_an_image_in_another_file_is_not_read(dataset, tmp_path, command):
    """Hugging Face's `datasets` would open, or download, the path that the table gives instead of an image."""
    (tmp_path / "secret.png").write_bytes(encoded(".png", np.full((152, 152, 3), 77, np.uint8)))
    change_image(dataset, RGB, None, tmp_path / "secret.png")
    with pytest.raises(ValueError, match="image"):
        command(dataset, tmp_path)


def test_an_image_in_another_file_is_not_used_for_training(dataset, tmp_path):
    (tmp_path / "secret.png").write_bytes(encoded(".png", np.full((152, 152, 3), 77, np.uint8)))
    change_image(dataset, RGB, None, tmp_path / "secret.png")
    with pytest.raises(SymviewError, match=RGB):
        open_dataset(DatasetLocation("test/malicious", dataset))
