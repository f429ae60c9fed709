"""Copies of harmless datasets and policies, for tests to change."""

import shutil

import pytest

from lerobot_policy_symview.processor_pipelines import make_processors
from tests.helpers.policies import make_policy
from tests.hostile.files import DATA


@pytest.fixture
def dataset(recorded, tmp_path):
    """A copy of a harmless dataset."""
    return shutil.copytree(recorded, tmp_path / "strangers" / "dataset")


@pytest.fixture
def outside(recorded, tmp_path):
    """A folder beside the dataset, with a table that could be one of its own."""
    folder = tmp_path / "strangers" / "private"
    (folder / "chunk-000").mkdir(parents=True)
    shutil.copy(recorded / DATA, folder / "chunk-000" / "file-000.parquet")
    (folder / "secret.txt").write_text("secret")
    return folder


@pytest.fixture(scope="session")
def harmless_policy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policy")
    policy = make_policy()
    for part in (policy, *make_processors(policy.config)):
        part.save_pretrained(folder)
    return folder


@pytest.fixture
def checkpoint(harmless_policy, tmp_path):
    """A copy of a harmless policy."""
    return shutil.copytree(harmless_policy, tmp_path / "checkpoint")
