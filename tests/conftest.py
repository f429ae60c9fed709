"""Shared fixtures: a tiny recorded dataset and the same with views, made once by the library itself."""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

# Hugging Face's libraries and numba read these when they are imported, which happens below.
os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["HF_DATASETS_DISABLE_PROGRESS_BARS"] = "1"
# Compiled kernels check every index, and are kept apart from those that do not.
os.environ["NUMBA_BOUNDSCHECK"] = "1"
if "PYTEST_XDIST_WORKER" not in os.environ:  # its workers share what the first process made
    scratch = tempfile.mkdtemp(prefix="symview-tests-")
    os.environ |= {"HF_HOME": f"{scratch}/huggingface", "NUMBA_CACHE_DIR": f"{scratch}/numba"}
    atexit.register(shutil.rmtree, scratch, ignore_errors=True)

import pytest
from hypothesis import settings

from lerobot_symview.datasets.add_views import AddViewsConfig, add_views
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.geometry.workspace import Workspace
from symview_sim.generate import GenerateConfig, generate
from symview_sim.settings import NewDataset

# The same examples every time, so that a failure can be repeated; no time limit, since the first one compiles.
settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=50)
settings.load_profile("repeatable")

VIEW_SIZE = 76
EPISODES = 2


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the slowest files, so that processes that share the rest end together."""
    items.sort(key=lambda item: [item.get_closest_marker(name) is None for name in ("slow", "long")])


@pytest.fixture
def unchecked_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands in processes of their own train as fast as for users: checking indices takes 3.5 times as long."""
    monkeypatch.setenv("NUMBA_BOUNDSCHECK", "0")
    monkeypatch.setenv("NUMBA_CACHE_DIR", f"{os.environ['NUMBA_CACHE_DIR']}-unchecked")


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a dataset of two demonstrations with the cameras `side` and `top`."""
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
