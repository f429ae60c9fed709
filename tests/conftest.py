"""Shared fixtures: a small recorded dataset and copies of it with views, created once per session by the library."""

import atexit
import multiprocessing
import os
import shutil
import tempfile
from multiprocessing import forkserver
from pathlib import Path

# Hugging Face's libraries and numba read these variables at import, which happens below.
os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["HF_DATASETS_DISABLE_PROGRESS_BARS"] = "1"
# Compiled kernels check array bounds; their cache is separate from that of unchecked kernels.
os.environ["NUMBA_BOUNDSCHECK"] = "1"
if "PYTEST_XDIST_WORKER" not in os.environ:  # xdist workers share the folders of the first process
    scratch = tempfile.mkdtemp(prefix="symview-tests-")
    os.environ |= {"HF_HOME": f"{scratch}/huggingface", "NUMBA_CACHE_DIR": f"{scratch}/numba"}
    # Without bytecode, which an environment may forbid, every process compiles PyTorch and LeRobot.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = f"{scratch}/bytecode"
    atexit.register(shutil.rmtree, scratch, ignore_errors=True)

import pytest
from hypothesis import settings

from lerobot_symview.datasets.add_views import AddViewsConfig, add_views
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.geometry.workspace import Workspace
from symview_sim.generate import GenerateConfig, generate
from symview_sim.settings import NewDataset

# Deterministic examples, so that failures are reproducible; no deadline, since the first example compiles kernels.
settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=50)
settings.load_profile("repeatable")

VIEW_SIZE = 76
EPISODES = 2
WORKER_MODULES = [
    "lerobot.envs.utils",
    "lerobot_symview.datasets.derivation",
    "symview_eval.experiments.cells",
    "symview_sim.env",
    "symview_sim.recording",
    "symview_sim.simulators",
]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the slowest files first, so that xdist workers finish at about the same time."""
    items.sort(key=lambda item: [item.get_closest_marker(name) is None for name in ("slow", "long")])


@pytest.fixture(scope="session", autouse=True)
def fork_server() -> None:
    """Import once what worker processes of all tests use: a fork server preloads what its first user names, no more."""
    if "PYTEST_XDIST_WORKER" in os.environ:  # most tests have no worker processes, but every run of all tests has
        multiprocessing.get_context("forkserver").set_forkserver_preload(WORKER_MODULES)
        forkserver.ensure_running()


@pytest.fixture
def unchecked_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable bounds checks in commands run as subprocesses: with checks, training takes 3.5 times as long."""
    monkeypatch.setenv("NUMBA_BOUNDSCHECK", "0")
    monkeypatch.setenv("NUMBA_CACHE_DIR", f"{os.environ['NUMBA_CACHE_DIR']}-unchecked")


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a dataset with two demonstrations and the cameras `side` and `top`."""
    folder = tmp_path_factory.mktemp("data") / "recorded"
    return generate(GenerateConfig(NewDataset("test/recorded", folder), num_episodes=EPISODES))


@pytest.fixture(scope="session")
def with_views(recorded: Path) -> Path:
    """Folder of the same dataset with both views added."""
    target = recorded.with_name("with_views")
    config = AddViewsConfig(
        HubDataset("test/recorded", recorded),
        new_repo_id="test/with_views",
        new_root=target,
        views=["reproj", "persp"],
        size=VIEW_SIZE,
    )
    return add_views(config)


@pytest.fixture(scope="session")
def only_views(recorded: Path) -> Path:
    """Folder of the same dataset with the reprojected view in place of the cameras' images."""
    target = recorded.with_name("only_views")
    config = AddViewsConfig(
        HubDataset("test/recorded", recorded),
        new_repo_id="test/only_views",
        new_root=target,
        size=VIEW_SIZE,
        keep=[],
    )
    return add_views(config)


@pytest.fixture
def workspace() -> Workspace:
    return Workspace()
