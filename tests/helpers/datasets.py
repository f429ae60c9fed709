"""Requests for views of a dataset, what a folder holds, and the images of a dataset."""

import numpy as np
from lerobot.datasets import LeRobotDataset

from lerobot_symview.datasets.add_views import AddViewsConfig
from lerobot_symview.datasets.hub import PushedDataset
from tests.conftest import VIEW_SIZE


def views_config(source, target, **options):
    defaults = {"new_repo_id": "test/derived", "new_root": target, "views": ["reproj", "persp"], "size": VIEW_SIZE}
    return AddViewsConfig(PushedDataset("test/recorded", source), **(defaults | options))


def contents(folder):
    return {file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def images_of(folder, key):
    dataset = LeRobotDataset("test/images", root=folder, depth_output_unit="m", video_backend="pyav")
    return np.stack([dataset[i][key].numpy() for i in range(len(dataset))])
