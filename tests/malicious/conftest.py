"""Copies of valid datasets and policies, which the tests modify."""

import shutil

import pytest

from lerobot_policy_symview.processor_pipelines import make_processors
from tests.helpers.policies import make_policy
from tests.malicious.files import DATA


@pytest.fixture
def dataset(recorded, tmp_path):
    """A copy of a valid dataset."""
    return shutil.copytree(recorded, tmp_path / "download" / "dataset")


@pytest.fixture
def outside(recorded, tmp_path):
    """A private folder beside the dataset, with a table in the format of the dataset's own."""
    folder = tmp_path / "download" / "private"
    (folder / "chunk-000").mkdir(parents=True)
    shutil.copy(recorded / DATA, folder / "chunk-000" / "file-000.parquet")
    (folder / "secret.txt").write_text("secret")
    return folder


@pytest.fixture(scope="session")
def valid_policy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policy")
    policy = make_policy()
    for part in (policy, *make_processors(policy.config)):
        part.save_pretrained(folder)
    return folder


@pytest.fixture
def checkpoint(valid_policy, tmp_path):
    """A copy of a valid policy."""
    return shutil.copytree(valid_policy, tmp_path / "checkpoint")
