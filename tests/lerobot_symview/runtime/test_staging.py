"""Files in `<target>.partial` that are removed, resumed or never modified."""

import json
import os
import shutil
from pathlib import Path

import pytest

from lerobot_symview.datasets.add_views import add_views
from lerobot_symview.runtime.cli import CommandError
from lerobot_symview.runtime.staging import (
    DATASET,
    DONE,
    REQUEST,
    is_complete,
    new_result,
    open_partial,
    remove_partial,
)
from tests.helpers.datasets import contents, views_config

DESCRIPTION = {"source": "test/recorded", "size": 76}


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "target.partial"


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize("name", ["notes.txt", REQUEST, "dataset/photo.png"])
def test_foreign_files_in_the_partial_folder_are_not_modified(recorded, tmp_path, name, resume):
    kept = tmp_path / "derived.partial" / name
    kept.parent.mkdir(parents=True)
    kept.write_text("user data")
    with pytest.raises(CommandError, match=rf"not created by an earlier run \({Path(name).parts[0]}\): move it"):
        add_views(views_config(recorded, tmp_path / "derived", resume=resume))
    assert kept.read_text() == "user data"
    assert not (tmp_path / "derived").exists()


def test_a_file_with_the_name_of_the_partial_folder_is_not_modified(folder):
    folder.write_text("user data")
    with pytest.raises(CommandError, match="it is a file"):
        open_partial(folder, DESCRIPTION, resume=True)
    assert folder.read_text() == "user data"


def test_a_complete_target_does_not_remove_a_foreign_partial_folder(folder, tmp_path):
    meta = tmp_path / "target" / "meta"
    for kept in (meta, folder):
        kept.mkdir(parents=True)
    (meta / "made.json").write_text('{"source": "test/recorded", "size": 76}')
    (folder / "notes.txt").write_text("user data")
    assert is_complete(tmp_path / "target", "made.json", DESCRIPTION, True, "--new_root")
    assert (folder / "notes.txt").exists()


def test_the_folder_of_a_command_killed_at_its_start_is_reused(folder):
    folder.mkdir()
    (folder / f"{REQUEST}.0123.part").write_text("{")
    open_partial(folder, DESCRIPTION, resume=False)
    assert (folder / REQUEST).exists()


def test_an_interrupted_removal_is_completed_and_not_resumed(folder, monkeypatch):
    open_partial(folder, DESCRIPTION, resume=False)
    (folder / "parts").mkdir()
    (folder / "parts" / "0").write_text("partly removed")

    def interrupted(path):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(shutil, "rmtree", interrupted)
        with pytest.raises(KeyboardInterrupt):
            remove_partial(folder)
    assert {path.name for path in folder.iterdir()} == {DONE, "parts"}
    open_partial(folder, DESCRIPTION, resume=True)
    assert [path.name for path in folder.iterdir()] == [REQUEST]


def test_a_run_killed_during_cleanup_is_complete(recorded, tmp_path, monkeypatch):
    target, folder = tmp_path / "derived", tmp_path / "derived.partial"
    with monkeypatch.context() as patched:
        patched.setattr("lerobot_symview.runtime.staging.remove_partial", lambda folder: None)
        add_views(views_config(recorded, target))
    before = contents(target)
    assert folder.exists()
    add_views(views_config(recorded, target, resume=True))
    assert contents(target) == before
    assert not folder.exists()


def test_a_second_run_is_refused_with_and_without_resume(folder, tmp_path):
    target = tmp_path / "target"
    with new_result(target, DESCRIPTION, resume=False, flag="--new_root"):
        for resume in (False, True):
            with pytest.raises(CommandError, match=f"target is being written by process {os.getpid()}.*--new_root"):
                new_result(target, DESCRIPTION, resume, "--new_root").__enter__()
        (folder / DATASET / "meta").mkdir(parents=True)
    assert list(tmp_path.iterdir()) == [target]


def test_a_run_that_has_waited_for_another_does_not_write_again(tmp_path):
    target = tmp_path / "target"
    target.mkdir()
    with pytest.raises(CommandError, match="exists already"):
        new_result(target, DESCRIPTION, True, "--new_root").__enter__()
    assert list(tmp_path.iterdir()) == [target]


def test_a_target_created_by_another_program_is_kept_and_so_is_the_result(folder, tmp_path):
    target = tmp_path / "target"
    writing = new_result(target, DESCRIPTION, resume=False, flag="--new_root")
    writing.__enter__()
    (folder / DATASET).mkdir()
    target.mkdir()
    with pytest.raises(CommandError, match=r"another program has created .*target: move it"):
        writing.__exit__(None, None, None)
    assert {path.name for path in folder.iterdir()} == {DATASET, REQUEST}


def test_a_complete_target_needs_no_lock(tmp_path, monkeypatch):
    meta = tmp_path / "target" / "meta"
    meta.mkdir(parents=True)
    (meta / "made.json").write_text(json.dumps(DESCRIPTION))
    monkeypatch.setattr("lerobot_symview.runtime.staging.locked", None)
    assert is_complete(tmp_path / "target", "made.json", DESCRIPTION, True, "--new_root")
