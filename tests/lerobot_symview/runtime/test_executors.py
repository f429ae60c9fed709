"""Worker processes and their fork server."""

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


def test_the_fork_server_ignores_ctrl_c():
    """The fork server's imports take seconds; an interrupt meanwhile would end it with a traceback."""
    done = subprocess.run([sys.executable, "-c", INTERRUPT], capture_output=True, text=True, timeout=120)
    assert (done.stdout, done.stderr) == ("[1]\n", "")
