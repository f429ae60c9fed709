"""Malformed metadata and calibrations are refused with a one-line error; valid ones are read."""

import json

import pytest

from lerobot_policy_symview.rl.demonstrations import open_dataset
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.datasets.metadata import RECORDING, read_settings
from lerobot_symview.errors import CalibrationError, SymviewError
from lerobot_symview.runtime.cli import DatasetLocation
from tests.malicious.files import (
    both_commands,
    change_info,
    derive,
    load_with_processors,
    show,
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &a [0, 0, 0]\nb: &b [*a, *a, *a]\nunits: m\ncameras: {front: *b}", "has an alias"),
        ("[" * 3000, "cannot read"),
        ("units: [m]\ncameras: {front: 1}", "units must be"),
    ],
)
def test_a_malformed_calibration_is_refused(tmp_path, text, message):
    """YAML aliases could multiply the size of arrays and messages with every line."""
    (tmp_path / "cameras.yaml").write_text(text)
    with pytest.raises((SymviewError, CalibrationError), match=message):
        read_calibration(tmp_path / "cameras.yaml")


@both_commands
@pytest.mark.parametrize("content", [b"[1]", b"\xff\xfe", b"[" * 100_000, b"{", b'{"codebase_version": "v3.0"}'])
def test_malformed_metadata_is_refused(dataset, tmp_path, command, content):
    (dataset / "meta" / "info.json").write_bytes(content)
    with pytest.raises(SymviewError, match=r"info\.json"):
        command(dataset, tmp_path)


@pytest.mark.parametrize("content", [b"[1]", b"[" * 100_000, b"{"])
def test_malformed_settings_are_refused(dataset, content):
    (dataset / "meta" / RECORDING).write_bytes(content)
    with pytest.raises(SymviewError, match=RECORDING):
        read_settings(dataset, RECORDING)


@both_commands
@pytest.mark.parametrize("feature", ["image", [], {}, {"dtype": "image", "shape": [8, 8, 3], "info": "mine"}])
def test_malformed_features_are_refused(dataset, tmp_path, command, feature):
    features = json.loads((dataset / "meta" / "info.json").read_text())["features"]
    change_info(dataset, features=features | {"unknown": feature})
    with pytest.raises(SymviewError, match="unknown"):
        command(dataset, tmp_path)


@pytest.mark.parametrize("entries", [{"chunks_size": 0}, {"chunks_size": "x"}, {"total_frames": "many"}])
def test_counts_in_metadata_must_be_counts(dataset, tmp_path, entries):
    change_info(dataset, **entries)
    with pytest.raises(SymviewError, match=next(iter(entries))):
        derive(dataset, tmp_path)


def test_valid_files_are_read(dataset, checkpoint, tmp_path):
    """The same commands accept the unmodified files."""
    for command in (derive, show):
        assert command(dataset, tmp_path).is_dir()
    assert len(open_dataset(DatasetLocation("test/valid", dataset))) == 14
    assert load_with_processors(checkpoint)
