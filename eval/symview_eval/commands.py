"""Console commands that need an extra: each says which one in one line where it is not installed."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn

EXTRAS = {
    "pybullet": "sim",
    "metaworld": "metaworld",
    "gymnasium_robotics": "fetch",
    "matplotlib": "viz",
    "rerun": "viz",
    "ray": "ray",
    "escnn": "escnn",
}
"""Module -> the extra of this distribution that installs it."""


def generate() -> None:
    """Run `symview-generate`, which imports the simulator of `--env.type`."""
    _run("symview_sim.generate", [])


def train_rl() -> None:
    """Run `symview-train-rl`."""
    _run("lerobot_policy_symview.rl.train_rl", ["pybullet"])


def benchmark() -> None:
    """Run `symview-benchmark`, whose suites all simulate."""
    _run("symview_eval.benchmarks.cli", ["pybullet"])


def experiment() -> None:
    """Run `symview-experiment`; its report alone needs no simulator."""
    reports = sys.argv[1:2] == ["report"]
    _run("symview_eval.experiments.cli", ["matplotlib"] if reports else ["pybullet", "matplotlib"])


def demo() -> None:
    """Run `symview-demo`."""
    _run("symview_eval.demo", ["pybullet", "matplotlib"])


def _run(module: str, needed: Sequence[str]) -> None:
    """Run `main` of a module, or end with one line if modules that it needs are not installed."""
    missing = [name for name in needed if find_spec(name) is None]
    if missing:
        _end(missing)
    try:
        import_module(module).main()
    except ModuleNotFoundError as error:  # for an option, such as --executor=ray or --env.type=metaworld
        if error.name not in EXTRAS:
            raise
        _end([error.name])


def _end(missing: Sequence[str]) -> NoReturn:
    extras = ",".join(dict.fromkeys(EXTRAS[name] for name in missing))
    names = " and ".join(missing)
    sys.stderr.write(
        f"{Path(sys.argv[0]).name}: error: {names} not installed: pip install 'lerobot_policy_symview[{extras}]'\n"
    )
    sys.exit(1)
