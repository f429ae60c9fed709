import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset

from lerobot_symview import keys
from lerobot_symview.add_views import AddViewsConfig, add_views
from lerobot_symview.camera import Camera
from lerobot_symview.cli import CommandError, DatasetTarget
from lerobot_symview.views import VIEWS, Frame, make_view
from lerobot_symview.workspace import Workspace
from tests.conftest import VIEW_SIZE


def parquet_columns(folder):
    tables = [pq.read_table(path) for path in sorted((folder / "data").rglob("*.parquet"))]
    assert len(tables) == 1
    return tables[0]


def test_every_original_column_is_kept_bit_for_bit(recorded, with_views):
    before, after = parquet_columns(recorded), parquet_columns(with_views)
    for name in before.column_names:
        assert before[name].to_pylist() == after[name].to_pylist(), name


def test_views_are_those_of_each_frame(recorded, with_views):
    source = LeRobotDataset("test/recorded", root=recorded, depth_output_unit="m")
    result = LeRobotDataset("test/with_views", root=with_views, depth_output_unit="m")
    assert len(result) == len(source)
    for index in (0, 3, len(source) - 1):
        item = source[index]
        rgb = (item[keys.rgb("side")] * 255).round().byte().permute(1, 2, 0).numpy()
        frame = Frame(
            rgb,
            item[keys.depth("side")][0].numpy(),
            Camera(
                item[keys.intrinsics("side")].numpy().reshape(3, 3),
                item[keys.world_from_cam("side")].numpy().reshape(4, 4),
                *rgb.shape[:2],
            ),
            Workspace(),
            item[keys.STATE].numpy(),
        )
        for name in VIEWS:
            for output, image in make_view(name, size=VIEW_SIZE).render(frame).items():
                stored = result[index][keys.view("side", output)].numpy()
                expected = image.transpose(2, 0, 1) / np.float32(255) if image.ndim == 3 else image[None]
                np.testing.assert_array_equal(stored, expected, err_msg=output)


def test_statistics_cover_the_new_keys(with_views):
    stats = json.loads((with_views / "meta" / "stats.json").read_text())
    dataset = LeRobotDataset("test/with_views", root=with_views, depth_output_unit="m")
    for name in VIEWS:
        for output in make_view(name).outputs:
            key = keys.view("side", output)
            values = np.stack([dataset[i][key].numpy() for i in range(len(dataset))])
            axes = (0, 2, 3)
            np.testing.assert_allclose(np.squeeze(stats[key]["min"]), np.squeeze(values.min(axes)), atol=1e-6)
            np.testing.assert_allclose(np.squeeze(stats[key]["mean"]), np.squeeze(values.mean(axes)), rtol=1e-3)
            np.testing.assert_allclose(np.squeeze(stats[key]["std"]), np.squeeze(values.std(axes)), rtol=1e-2)


def test_the_statistics_of_depth_stay_in_metres(recorded, with_views):
    before, after = (json.loads((folder / "meta" / "stats.json").read_text()) for folder in (recorded, with_views))
    for key in (keys.depth("side"), keys.depth("top"), keys.ACTION):
        np.testing.assert_allclose(after[key]["max"], before[key]["max"])


def test_a_view_says_how_it_was_made(with_views):
    features = json.loads((with_views / "meta" / "info.json").read_text())["features"]
    made = features["observation.images.side_reproj"]["info"]["symview"]
    assert make_view(made["view"], **made["options"]) == make_view("reproj", size=VIEW_SIZE)
    assert made["workspace"] == {"center": [0.45, 0.0], "size": 0.4, "height_limit": 0.25}


def test_keep_drops_the_other_images(only_views):
    dataset = LeRobotDataset("test/only_views", root=only_views)
    assert sorted(dataset.meta.camera_keys) == [
        "observation.images.side_reproj",
        "observation.images.side_reproj_height",
    ]
    assert keys.intrinsics("side") in dataset.meta.features


def test_the_source_is_not_modified_and_the_target_not_overwritten(recorded, with_views):
    before = {path: path.read_bytes() for path in recorded.rglob("*") if path.is_file()}
    with pytest.raises(CommandError, match="exists already"):
        add_views(AddViewsConfig(DatasetTarget("test/recorded", recorded), new_root=with_views))
    assert {path: path.read_bytes() for path in recorded.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"camera": "wrist"}, ValueError, "calibrated cameras: .*side"),
        ({"keep": ["front"]}, ValueError, "--keep names .*front"),
        ({"dataset": DatasetTarget("no/where")}, CommandError, "no dataset at"),
    ],
)
def test_a_mistake_is_named_and_leaves_nothing_behind(recorded, tmp_path, options, error, message):
    target = tmp_path / "target"
    config = AddViewsConfig(**({"dataset": DatasetTarget("test/recorded", recorded), "new_root": target} | options))
    with pytest.raises(error, match=message):
        add_views(config)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("views", [[], ["reprojection"]])
def test_unknown_views_are_refused_before_anything_is_read(views):
    with pytest.raises(ValueError, match=r"view"):
        AddViewsConfig(DatasetTarget("a/b"), views=views)
