import json
import re
import shutil
import sys
from dataclasses import dataclass

import draccus
import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.scripts import lerobot_train

from lerobot_symview import keys
from lerobot_symview.datasets.add_views import AddViewsConfig, add_views
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.datasets.source import SourceDataset
from lerobot_symview.errors import DatasetError, OptionError, SymviewError
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import VIEWS, Frame, PerspectiveView, ReprojectedView, View, ViewSpec, make_view
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset
from tests.conftest import VIEW_SIZE
from tests.helpers.datasets import change_feature, contents, images_of, rewrite_depth, views_config
from tests.helpers.packages import registered


def parquet_columns(folder):
    tables = [pq.read_table(path) for path in sorted((folder / "data").rglob("*.parquet"))]
    assert len(tables) == 1
    return tables[0]


def test_original_columns_are_bit_identical(recorded, with_views):
    before, after = parquet_columns(recorded), parquet_columns(with_views)
    for name in before.column_names:
        assert before[name].to_pylist() == after[name].to_pylist(), name


def test_stored_views_equal_rendered_views(recorded, with_views):
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


def test_depth_statistics_stay_in_metres(recorded, with_views):
    before, after = (json.loads((folder / "meta" / "stats.json").read_text()) for folder in (recorded, with_views))
    for key in (keys.depth("side"), keys.depth("top"), keys.ACTION):
        np.testing.assert_allclose(after[key]["max"], before[key]["max"])


def test_view_features_store_their_options_and_workspace(with_views):
    features = json.loads((with_views / "meta" / "info.json").read_text())["features"]
    made = features["observation.images.side_reproj"]["info"]["symview"]
    assert make_view(made["view"], **made["options"]) == make_view("reproj", size=VIEW_SIZE)
    assert made["workspace"] == {"center": [0.45, 0.0], "size": 0.4, "height_limit": 0.25}


def test_images_not_in_keep_are_dropped(only_views):
    dataset = LeRobotDataset("test/only_views", root=only_views)
    assert sorted(dataset.meta.camera_keys) == [
        "observation.images.side_reproj",
        "observation.images.side_reproj_height",
    ]
    assert keys.intrinsics("side") in dataset.meta.features


def test_the_source_is_not_modified_and_an_existing_target_not_overwritten(recorded, with_views):
    before = {path: path.read_bytes() for path in recorded.rglob("*") if path.is_file()}
    with pytest.raises(SymviewError, match="exists already"):
        add_views(AddViewsConfig(HubDataset("test/recorded", recorded), new_root=with_views))
    assert {path: path.read_bytes() for path in recorded.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"camera": "wrist"}, DatasetError, "--camera=wrist.* lacks .*cameras with calibration: side, top"),
        ({"keep": ["front"]}, ValueError, "--keep names .*front"),
        ({"dataset": HubDataset("no/where")}, DatasetError, "--dataset: there is no LeRobot dataset in"),
    ],
)
def test_invalid_flags_raise_an_error_and_write_nothing(recorded, tmp_path, options, error, message):
    target = tmp_path / "target"
    config = AddViewsConfig(**({"dataset": HubDataset("test/recorded", recorded), "new_root": target} | options))
    with pytest.raises(error, match=message):
        add_views(config)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_videos_are_copied_and_give_the_views_of_their_images(tmp_path):
    """Lossless colour videos give identical views; quantised depth changes few points."""
    env = RecordedEnv(camera=CameraSpec(height=64, width=64), oracle=False)
    folders = {}
    for video in (False, True):
        target = NewDataset("test/recorded", tmp_path / f"source-{video}")
        source = generate(GenerateConfig(target, env=env, num_episodes=2, video=video))
        folders[video] = add_views(views_config(source, tmp_path / f"views-{video}"))
    copied = {path: data for path, data in contents(folders[True]).items() if path.suffix == ".mp4"}
    assert copied
    assert copied == {path: data for path, data in contents(tmp_path / "source-True").items() if path.suffix == ".mp4"}
    key = keys.view("side", "persp")
    np.testing.assert_array_equal(images_of(folders[True], key), images_of(folders[False], key))
    key = keys.view("side", "reproj_height")
    difference = np.abs(images_of(folders[True], key) - images_of(folders[False], key))
    assert (difference > 3e-4).mean() < 0.02
    source = tmp_path / "source-True"
    only = add_views(views_config(source, tmp_path / "only", keep=[]))
    assert not (only / "videos").exists()
    np.testing.assert_array_equal(images_of(only, key), images_of(folders[True], key))
    lost = next((source / "videos" / keys.depth("side")).rglob("*.mp4"))
    lost.unlink()
    with pytest.raises(SymviewError, match=rf"lacks videos/{keys.depth('side')}/.*file-000\.mp4: download or copy"):
        add_views(views_config(source, tmp_path / "never"))
    assert not (tmp_path / "never.partial").exists()
    add_views(views_config(source, tmp_path / "without_depth", views=["persp"], keep=[]))  # persp does not read depth


@pytest.mark.parametrize("views", [[], ["reprojection"]])
def test_empty_or_unknown_views_are_rejected_by_the_configuration(views):
    with pytest.raises(OptionError, match=r"view"):
        AddViewsConfig(HubDataset("a/b"), views=views)


@pytest.mark.parametrize("name", ["views", "me/", "a/b/c"])
def test_an_invalid_new_repo_id_is_rejected(name):
    with pytest.raises(ValueError, match=f"--new_repo_id must look like user/name, got '{name}'"):
        AddViewsConfig(HubDataset("a/b"), new_repo_id=name)


@pytest.mark.parametrize("target", ["source/views", "source/meta/views", "source", ".", "link/views"])
def test_source_and_result_inside_each_other_are_rejected(recorded, tmp_path, target):
    source = tmp_path / "source"
    shutil.copytree(recorded, source)
    (tmp_path / "link").symlink_to(source)
    before = contents(tmp_path)
    with pytest.raises(ValueError, match="neither may be inside the other, choose another --new_root"):
        add_views(views_config(source, tmp_path / target))
    assert contents(tmp_path) == before


def test_a_source_inside_the_partial_folder_is_rejected(recorded, tmp_path):
    source = tmp_path / "views.partial" / "source"
    shutil.copytree(recorded, source)
    with pytest.raises(ValueError, match="choose another --new_root"):
        add_views(views_config(source, tmp_path / "views"))


@pytest.mark.long
def test_lerobots_act_policy_trains_on_views_for_stock_policies(recorded, tmp_path, monkeypatch):
    source = views_config(recorded, tmp_path / "stock", for_stock_policies=True)
    dataset = LeRobotDataset("test/stock", root=add_views(source))
    assert set(dataset.meta.camera_keys) == {keys.view("side", name) for name in ("reproj", "persp", "persp_gripper")}
    assert set(dataset.meta.stats) == set(dataset.meta.features)
    made = dataset.meta.features[keys.view("side", "reproj")]["info"]["symview"]
    assert make_view(made["view"], **made["options"]).outputs == {"reproj": "rgb"}
    arguments = ["--dataset.repo_id=test/stock", f"--dataset.root={tmp_path / 'stock'}", "--policy.type=act"]
    arguments += ["--policy.push_to_hub=false", "--policy.device=cpu", "--policy.pretrained_backbone_weights=null"]
    arguments += ["--policy.dim_model=32", "--policy.n_heads=2", "--policy.dim_feedforward=32", "--policy.chunk_size=4"]
    arguments += ["--policy.n_action_steps=4", "--steps=2", "--batch_size=2", "--num_workers=0", "--env_eval_freq=0"]
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *arguments, f"--output_dir={tmp_path / 'act'}"])
    lerobot_train.main()
    assert (tmp_path / "act" / "checkpoints" / "last" / "pretrained_model" / "model.safetensors").is_file()


def test_keep_adds_source_images_for_stock_policies(recorded, tmp_path):
    config = views_config(recorded, tmp_path / "stock", for_stock_policies=True, views=["reproj"], keep=["side"])
    images = LeRobotDataset("test/stock", root=add_views(config)).meta.camera_keys
    assert set(images) == {keys.rgb("side"), keys.view("side", "reproj")}


def test_a_one_channel_view_is_rejected_for_stock_policies():
    @dataclass(frozen=True)
    class Metres(View):
        size: int = 8
        outputs = {"metres": "height"}  # noqa: RUF012

        def render(self, frame):
            return {"metres": np.zeros((self.size, self.size), np.float32)}

    with registered(VIEWS, "metres", Metres):
        AddViewsConfig(HubDataset("a/b"), views=["metres"])
        with pytest.raises(ValueError, match=r"--for_stock_policies=true .* the view outputs metres, which has one"):
            AddViewsConfig(HubDataset("a/b"), views=["metres"], for_stock_policies=True)


def test_list_options_override_size_and_dotted_flags(recorded, tmp_path):
    """Options in `--views` override `--size`, which overrides dotted flags."""
    arguments = ["--dataset.repo_id=a/b", "--views=[reproj, {name: persp, plane_height: 0.025, size: 40}]", "--size=76"]
    config = draccus.parse(AddViewsConfig, args=[*arguments, "--reproj.infill=local", "--persp.gripper=false"])
    views = config.make_views()
    assert views["reproj"] == ReprojectedView(size=76, infill="local")
    assert views["persp"] == PerspectiveView(size=40, plane_height=0.025, gripper=False)
    with pytest.raises(OptionError, match="the view 'persp' has no option plain_height; it has size, plane_height"):
        AddViewsConfig(HubDataset("a/b"), views=[ViewSpec("persp", {"plain_height": 1})])


def test_without_gripper_dimensions_views_are_unclipped_and_have_no_gripper_image(recorded, tmp_path, caplog):
    source = tmp_path / "joints"
    shutil.copytree(recorded, source)
    change_feature(source, keys.STATE, names=[f"joint_{i}" for i in range(5)])
    caplog.set_level("INFO")
    result = add_views(views_config(source, tmp_path / "views"))
    assert re.search(r"it fills a view of \d+ x \d+ pixels, reproj has \d+, persp has \d+", caplog.text)
    assert "rendered without clipping at the gripper" in caplog.text
    features = SourceDataset(result).features
    assert keys.view("side", "persp_gripper") not in features
    assert features[keys.view("side", "reproj")]["info"]["symview"]["options"]["clip"] == "none"
    expected = add_views(
        views_config(recorded, tmp_path / "unclipped", reproj=ReprojectedView(clip="none"), views=["reproj"])
    )
    key = keys.view("side", "reproj")
    np.testing.assert_array_equal(images_of(result, key), images_of(expected, key))


@pytest.mark.parametrize("declared", [True, False])
def test_depth_in_float_millimetres_gives_the_same_views(recorded, tmp_path, declared, caplog):
    """An undeclared unit is inferred once per dataset and logged."""
    caplog.set_level("INFO")
    source, key = tmp_path / "millimetres", keys.depth("side")
    shutil.copytree(recorded, source)
    rewrite_depth(source, key, lambda depth: depth * np.float32(1000))
    change_feature(source, key, info={"is_depth_map": True} | ({"depth_unit": "mm"} if declared else {}))
    result = add_views(views_config(source, tmp_path / "views", views=["reproj"]))
    assert (f"{key} declares no depth_unit: the table at z = 0 shows millimetres" in caplog.text) != declared
    view = keys.view("side", "reproj_height")
    expected = add_views(views_config(recorded, tmp_path / "expected", views=["reproj"]))
    np.testing.assert_allclose(images_of(result, view), images_of(expected, view), atol=1e-5)


@pytest.mark.parametrize("file", ["meta/stats.json", "data/chunk-000/file-000.parquet"])
def test_a_missing_source_file_raises_an_error_before_any_output(recorded, tmp_path, file):
    source = tmp_path / "source"
    shutil.copytree(recorded, source)
    (source / file).unlink()
    with pytest.raises(SymviewError, match=rf"dataset in .* lacks {file}: download or copy it again"):
        add_views(views_config(source, tmp_path / "never"))
    assert list(tmp_path.iterdir()) == [source]
