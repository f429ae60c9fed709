"""Requests for views of a dataset, and what a folder holds."""

from lerobot_symview.add_views import AddViewsConfig
from lerobot_symview.hub import PushedDataset
from tests.conftest import VIEW_SIZE


def views_config(source, target, **options):
    defaults = {"new_repo_id": "test/derived", "new_root": target, "views": ["reproj", "persp"], "size": VIEW_SIZE}
    return AddViewsConfig(PushedDataset("test/recorded", source), **(defaults | options))


def contents(folder):
    return {file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()}
