"""The lock of a run: held while its process lives, stopped or not, and released however it ends."""

import errno
import fcntl
import os
import signal
import subprocess
import sys

import pytest

from lerobot_symview.runtime.cli import CommandError
from lerobot_symview.runtime.locking import locked

HOLDING = """
import subprocess, sys, time
from pathlib import Path
from lerobot_symview.runtime.locking import locked
with locked(Path(sys.argv[1]), Path("out"), "--root"):
    child = subprocess.Popen(["sleep", "600"])
    print(child.pid, flush=True)
    time.sleep(600)
"""


@pytest.fixture
def file(tmp_path):
    return tmp_path / "new" / "out.lock"


def hold(file):
    return locked(file, file.with_name("out"), "--root")


def test_the_lock_file_is_removed_even_if_the_run_fails(file):
    with pytest.raises(ZeroDivisionError), hold(file):
        raise ZeroDivisionError
    assert not file.exists()
    with hold(file):
        assert file.exists()


def test_a_second_run_is_refused_and_leaves_the_lock(file):
    with hold(file):
        for _ in range(2):
            with pytest.raises(CommandError, match=rf"out is being written by process {os.getpid()} on .*--root"):
                hold(file).__enter__()
        assert file.exists()


def test_a_paused_process_keeps_the_lock_and_a_killed_one_loses_it(file):
    """A program that the killed process has started lives on."""
    with subprocess.Popen([sys.executable, "-c", HOLDING, file], stdout=subprocess.PIPE, text=True) as process:
        child = int(process.stdout.readline())
        try:
            process.send_signal(signal.SIGSTOP)
            with pytest.raises(CommandError, match=f"by process {process.pid} on .*: wait until it ends, or choose"):
                hold(file).__enter__()
            process.kill()
            process.wait()
            os.kill(child, 0)
            with hold(file):
                assert file.read_text().startswith(f"process {os.getpid()} ")
        finally:
            process.kill()
            os.kill(child, signal.SIGKILL)
    assert not file.exists()


def test_a_run_that_removes_the_lock_meanwhile_is_not_joined(file, monkeypatch):
    def flock(stream, operation):
        file.unlink()

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(CommandError, match="by another run: wait until it ends"):
        hold(file).__enter__()


def test_a_folder_that_cannot_be_written_is_reported_in_words(file):
    file.parent.write_text("no folder")
    with pytest.raises(CommandError, match=r"cannot write to .*new \(File exists\): choose another --root"):
        hold(file).__enter__()


def test_a_file_system_without_locks_is_reported_and_used(file, monkeypatch, caplog):
    def flock(stream, operation):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", flock)
    with hold(file):
        assert "out.lock is not locked (No locks available): do not start a second run" in caplog.text
