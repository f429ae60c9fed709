"""Processes that do work, and the server they are forked from."""

import subprocess
import sys

INTERRUPT = """
import os
import signal
from multiprocessing import forkserver

from lerobot_symview.runtime.executors import ProcessExecutor

with ProcessExecutor(1, "lerobot_symview.datasets.derivation") as executor:
    os.kill(forkserver._forkserver._forkserver_pid, signal.SIGINT)
    print(list(executor.run(abs, [-1])))
"""


def test_ctrl_c_is_left_to_the_process_that_started_the_others():
    """The server imports for seconds, in which an interrupt would end it with a traceback."""
    done = subprocess.run([sys.executable, "-c", INTERRUPT], capture_output=True, text=True, timeout=120)
    assert (done.stdout, done.stderr) == ("[1]\n", "")
