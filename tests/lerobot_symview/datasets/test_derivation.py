"""Results are bit-identical for any number of processes, and after interruptions and crashes."""

import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset, aggregate_datasets

from lerobot_symview import keys
from lerobot_symview.datasets import derivation
from lerobot_symview.datasets.add_views import add_views
from lerobot_symview.datasets.source import SourceDataset
from lerobot_symview.runtime.cli import CommandError
from tests.conftest import VIEW_SIZE
from tests.helpers.datasets import contents, interrupted_at_the_second_part, views_config
from tests.helpers.files import largest_file

pytestmark = pytest.mark.long


@pytest.fixture
def small_parts(monkeypatch):
    """Cut one part per episode."""
    monkeypatch.setattr(derivation, "PART_FRAMES", 1)


@pytest.fixture
def reference(recorded, small_parts, tmp_path):
    """Files written by one uninterrupted process."""
    return contents(add_views(views_config(recorded, tmp_path / "reference")))


@pytest.fixture
def several_files(recorded, tmp_path):
    """A dataset of three files with two episodes each, and so of three parts."""
    folder = tmp_path / "several"
    names = ["test/recorded"] * 3
    aggregate_datasets(names, "test/several", [recorded] * 3, folder, concatenate_data=False)
    assert len(list(folder.glob("data/*/*.parquet"))) == 3
    return folder


def test_the_result_does_not_depend_on_the_number_of_processes(recorded, reference, tmp_path):
    assert contents(add_views(views_config(recorded, tmp_path / "derived", num_workers=2))) == reference


def test_parts_are_cut_at_episodes_within_files(recorded, small_parts):
    source = SourceDataset(recorded)
    assert derivation.cut_parts(source) == [range(0, 1), range(1, 2)]


def test_an_interrupted_run_is_resumed(recorded, reference, tmp_path, monkeypatch):
    target = tmp_path / "derived"
    with interrupted_at_the_second_part(monkeypatch):
        add_views(views_config(recorded, target))
    assert not target.exists()
    with pytest.raises(CommandError, match="is from an interrupted run: add --resume=true"):
        add_views(views_config(recorded, target))
    with pytest.raises(CommandError, match="is from a run with different views: repeat that command"):
        add_views(views_config(recorded, target, size=VIEW_SIZE + 2, resume=True))
    kept = next((tmp_path / "derived.partial").rglob("*.parquet"))
    written_at = kept.stat().st_mtime_ns
    add_views(views_config(recorded, target, resume=True))
    assert contents(target) == reference
    assert (target / kept.relative_to(tmp_path / "derived.partial" / "dataset")).stat().st_mtime_ns == written_at
    before = contents(target)
    add_views(views_config(recorded, target, resume=True))  # already complete
    assert contents(target) == before
    assert not (tmp_path / "derived.partial").exists()


def add_views_command(source, target):
    """Return the command with the settings of `views_config`."""
    command = [Path(sys.executable).parent / "symview-add-views", "--dataset.repo_id=test/recorded"]
    command += [f"--root={source}", "--new_repo_id=test/derived", f"--new_root={target}", "--resume=true"]
    return [*command, "--views=[reproj, persp]", f"--size={VIEW_SIZE}"]


FORKING = f"""
import os, pathlib, sys
import cv2, datasets
from lerobot_symview.datasets import add_views, derivation
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.views import *
from tests.helpers.cameras import make_frame
cv2.setNumThreads(0)  # threads do not survive a fork
for name in VIEWS:  # compiled once
    make_view(name).render(make_frame())
source, target = map(pathlib.Path, sys.argv[1:])
for _ in sys.stdin:
    child = os.fork()
    if child == 0:
        derivation.PART_FRAMES = 1
        add_views.add_views(add_views.AddViewsConfig(
            HubDataset('test/recorded', source), new_repo_id='test/derived', new_root=target,
            views=['reproj', 'persp'], size={VIEW_SIZE}, resume=True))
        os._exit(0)
    print(child, flush=True)
    print(os.waitpid(child, 0)[1], flush=True)
"""


def test_a_killed_process_keeps_finished_parts(recorded, reference, tmp_path):
    """SIGKILL after a random, growing delay until one run completes."""
    target = tmp_path / "derived"
    rng, kills = np.random.default_rng(0), 0
    command = [sys.executable, "-c", FORKING, str(recorded), str(target)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as forking:
        for attempt in range(40):
            forking.stdin.write(b"go\n")
            forking.stdin.flush()
            child = int(forking.stdout.readline())
            time.sleep(0.05 * attempt + rng.uniform(0, 0.1))
            with suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
            status = int(forking.stdout.readline())
            if status == 0 and kills == 0:  # on a busy machine the first runs may end before they are killed
                shutil.rmtree(target)
                continue
            if status == 0:
                break
            assert status == signal.SIGKILL
            kills += 1
            assert not target.exists() or contents(target) == reference
    assert contents(target) == reference
    assert kills > 0


def test_a_full_disk_raises_an_error_and_the_run_can_be_resumed(recorded, reference, tmp_path):
    target = tmp_path / "derived"
    with largest_file(30_000), pytest.raises(CommandError, match=r"cannot write to .*MiB free.*--resume=true"):
        add_views(views_config(recorded, target))
    assert not target.exists()
    add_views(views_config(recorded, target, resume=True))
    assert contents(target) == reference


def test_row_groups_may_be_of_any_size(recorded, reference, tmp_path):
    source = tmp_path / "recut"
    shutil.copytree(recorded, source)
    file = next(source.rglob("data/**/*.parquet"))
    pq.write_table(pq.read_table(file), file, row_group_size=5)
    result = add_views(views_config(source, tmp_path / "derived"))
    for path, data in reference.items():
        if path.parts[0] == "data":
            assert (result / path).read_bytes() == data


def test_a_source_of_several_files_gets_views_in_every_file(several_files, with_views, tmp_path):
    result = LeRobotDataset("test/derived", root=add_views(views_config(several_files, tmp_path / "derived")))
    once = LeRobotDataset("test/with_views", root=with_views)
    assert len(result) == 3 * len(once)
    assert len(list(result.root.glob("data/*/*.parquet"))) == 3
    images = [
        key for key in once.meta.camera_keys if key.startswith((keys.view("side", "reproj"), keys.view("side", "p")))
    ]
    for index in range(len(result)):
        copy, original = result[index], once[index % len(once)]
        assert int(copy["index"]) == index
        for key in images:
            assert (copy[key] == original[key]).all(), (index, key)
    for key in images:
        np.testing.assert_allclose(result.meta.stats[key]["mean"], once.meta.stats[key]["mean"], rtol=1e-6)
        assert result.meta.stats[key]["count"] == 3 * once.meta.stats[key]["count"]
    for episode in range(6):
        place = result.meta.get_data_file_path(episode)
        assert episode in pq.read_table(result.root / place, columns=["episode_index"])["episode_index"].to_pylist()


def paused_run(source, target):
    """Start a run and pause it while it writes; on a busy machine, one may end first, and is begun again."""
    while True:
        process = subprocess.Popen(add_views_command(source, target), stdout=subprocess.DEVNULL)
        while not target.with_name(f"{target.name}.partial").exists() and process.poll() is None:
            time.sleep(0.005)
        process.send_signal(signal.SIGSTOP)
        if not target.exists():
            assert process.poll() is None
            return process
        process.send_signal(signal.SIGCONT)
        assert process.wait() == 0
        shutil.rmtree(target)


def test_a_second_run_is_refused_while_the_first_is_paused(several_files, tmp_path):
    """And the first, once it goes on, writes what it would have written alone."""
    target = tmp_path / "derived"
    process = paused_run(several_files, target)
    for resume in (False, True):
        with pytest.raises(CommandError, match=f"derived is being written by process {process.pid} on .*--new_root"):
            add_views(views_config(several_files, target, resume=resume))
    process.send_signal(signal.SIGCONT)
    assert process.wait() == 0
    assert sorted(tmp_path.iterdir()) == [target, several_files]
    assert contents(target) == contents(add_views(views_config(several_files, tmp_path / "alone")))


def test_two_killed_worker_processes_keep_finished_parts(several_files, tmp_path):
    """SIGKILL before and during the parts; the resumed run is bit-identical to an uninterrupted one."""
    target, partial = tmp_path / "derived", tmp_path / "derived.partial"
    command = [*add_views_command(several_files, target), "--num_workers=2"]
    conditions = [lambda: partial.exists(), lambda: any(partial.glob("dataset/data/*/*.parquet"))]
    rng = np.random.default_rng(0)
    for condition in conditions:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while not condition():
            assert process.poll() is None
            time.sleep(0.005)
        time.sleep(rng.uniform(0, 0.05))
        process.kill()
        assert process.wait() == -signal.SIGKILL
        assert not target.exists()
    subprocess.run(command, check=True, capture_output=True)
    assert not partial.exists()
    assert contents(target) == contents(add_views(views_config(several_files, tmp_path / "uninterrupted")))
