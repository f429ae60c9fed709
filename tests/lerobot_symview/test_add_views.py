import json
import re
import shutil
import sys
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
import yaml
from lerobot.datasets import LeRobotDataset, modify_features
from lerobot.scripts import lerobot_train

from lerobot_policy_symview.processor_views import ViewsProcessorStep
from lerobot_symview import keys
from lerobot_symview.add_views import AddViewsConfig, add_views
from lerobot_symview.calibration import (
    Calibration,
    parse_calibration,
    parse_workspace,
    plain_calibration,
    read_calibration,
)
from lerobot_symview.camera import CalibrationError, Camera, intrinsics_from_fov, orbit_pose, stored_camera
from lerobot_symview.cli import CommandError, DatasetTarget
from lerobot_symview.features import camera_features
from lerobot_symview.hub import PushedDataset
from lerobot_symview.placement import CameraSpec, CameraSpread
from lerobot_symview.source_dataset import vectors
from lerobot_symview.views import VIEWS, Frame, make_view
from lerobot_symview.workspace import Workspace
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset
from tests.conftest import VIEW_SIZE
from tests.lerobot_symview.derived import contents, views_config
from tests.lerobot_symview.test_upsampling import plane_depth

NO_GRIPPER = make_view("persp", size=VIEW_SIZE, gripper=False)


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
        add_views(AddViewsConfig(PushedDataset("test/recorded", recorded), new_root=with_views))
    assert {path: path.read_bytes() for path in recorded.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"camera": "wrist"}, ValueError, "calibrated cameras: .*side"),
        ({"keep": ["front"]}, ValueError, "--keep names .*front"),
        ({"dataset": DatasetTarget("no/where")}, CommandError, "there is no dataset in"),
    ],
)
def test_a_mistake_is_named_and_leaves_nothing_behind(recorded, tmp_path, options, error, message):
    target = tmp_path / "target"
    config = AddViewsConfig(**({"dataset": PushedDataset("test/recorded", recorded), "new_root": target} | options))
    with pytest.raises(error, match=message):
        add_views(config)
    assert list(tmp_path.iterdir()) == []


def images_of(folder, key):
    dataset = LeRobotDataset("test/images", root=folder, depth_output_unit="m", video_backend="pyav")
    return np.stack([dataset[i][key].numpy() for i in range(len(dataset))])


def test_videos_are_copied_and_seen_as_the_images_they_were(tmp_path):
    """Of lossless videos the views are those of the images; depth, stored in steps, moves few points."""
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
    with pytest.raises(CommandError, match=rf"lacks videos/{keys.depth('side')}/.*file-000\.mp4: download or copy"):
        add_views(views_config(source, tmp_path / "never"))
    assert not (tmp_path / "never.partial").exists()
    add_views(views_config(source, tmp_path / "without_depth", views=["persp"], keep=[]))  # which that video is not for


def test_calibration_may_come_from_a_file(recorded, with_views, tmp_path):
    """A dataset without calibration gets the same views from a file, and the calibration with them."""
    source = LeRobotDataset("test/recorded", root=recorded)
    calibrations = [key for key in source.meta.features if key.startswith("observation.camera.")]
    matrices = {key: source[0][key].tolist() for key in calibrations}
    modify_features(source, remove_features=calibrations, output_dir=tmp_path / "bare", repo_id="test/bare")
    with pytest.raises(ValueError, match=r"lacks observation\.camera.*calibrated cameras: none, see --calibration"):
        add_views(views_config(tmp_path / "bare", tmp_path / "never"))
    side = {"height": 152, "width": 152, "intrinsics": np.reshape(matrices[keys.intrinsics("side")], (3, 3)).tolist()}
    side["world_from_cam"] = np.reshape(matrices[keys.world_from_cam("side")], (4, 4)).tolist()
    file = tmp_path / "cameras.yaml"
    file.write_text(yaml.safe_dump({"units": "m", "cameras": {"side": side}}))
    result = add_views(views_config(tmp_path / "bare", tmp_path / "derived", calibration=file))
    for name in VIEWS:
        for output in make_view(name).outputs:
            key = keys.view("side", output)
            np.testing.assert_array_equal(images_of(result, key), images_of(with_views, key))
    dataset = LeRobotDataset("test/derived", root=result)
    assert dataset[0][keys.world_from_cam("side")].tolist() == matrices[keys.world_from_cam("side")]
    assert dataset.meta.stats[keys.intrinsics("side")]["std"].tolist() == [0.0] * 9
    with pytest.raises(ValueError, match=r"has observation\.camera\.side\.intrinsics.* already"):
        add_views(views_config(recorded, tmp_path / "never", calibration=file))
    file.write_text(yaml.safe_dump({"units": "m", "cameras": {"side": side | {"height": 76, "width": 76}}}))
    with pytest.raises(CalibrationError, match=r"principal point|152 x 152"):
        add_views(views_config(tmp_path / "bare", tmp_path / "never", calibration=file))
    assert not list(tmp_path.glob("never*"))


def test_a_camera_that_moves_is_followed(tmp_path):
    camera = CameraSpec(height=64, width=64, spread=CameraSpread(azimuth_deg=180.0, elevation_deg=20.0))
    env = RecordedEnv(camera=camera, oracle=False)
    target = NewDataset("test/recorded", tmp_path / "moving")
    source = LeRobotDataset("test/moving", root=generate(GenerateConfig(target, env=env, num_episodes=2)))
    result = LeRobotDataset("test/v", root=add_views(views_config(tmp_path / "moving", tmp_path / "derived")))
    key = keys.world_from_cam("side")
    assert (source[0][key] != source[len(source) - 1][key]).any()
    for index in (0, len(source) - 1):
        item = source[index]
        camera = stored_camera(item[keys.intrinsics("side")].numpy(), item[key].numpy(), 64, 64)
        rgb = (item[keys.rgb("side")] * 255).round().byte().permute(1, 2, 0).numpy()
        frame = Frame(rgb, None, camera, Workspace(), item[keys.STATE].numpy())
        expected = make_view("persp", size=VIEW_SIZE).render(frame)["persp"]
        stored = (result[index][keys.view("side", "persp")] * 255).round().byte().permute(1, 2, 0).numpy()
        np.testing.assert_array_equal(stored, expected)


def test_a_camera_that_moves_within_an_episode_is_followed(tmp_path):
    """On a wrist, say: every frame's reprojection is made with the pose of that frame."""
    source = LeRobotDataset.create(
        "test/wrist",
        fps=10,
        root=tmp_path / "wrist",
        use_videos=False,
        features=camera_features("wrist", 48, 64, {})
        | {keys.ACTION: {"dtype": "float32", "shape": (1,), "names": None}},
    )
    rng, expected = np.random.default_rng(0), []
    view = make_view("reproj", size=32, clip="none")
    for azimuth in np.linspace(0, 2, 6):
        pose = orbit_pose(0.8, azimuth, 0.6 + 0.1 * azimuth, (0.45, 0.0, 0.0)).astype(np.float32)
        intrinsics = intrinsics_from_fov(0.9, 48, 64).astype(np.float32)
        camera = stored_camera(intrinsics.ravel(), pose.ravel(), 48, 64)
        rgb = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
        depth = plane_depth(camera, height=0.03).astype(np.float32)
        expected.append(view.render(Frame(rgb, depth, camera, Workspace())))
        frame = {keys.rgb("wrist"): rgb, keys.depth("wrist"): depth[..., None], keys.ACTION: np.zeros(1, np.float32)}
        calibration = {keys.intrinsics("wrist"): intrinsics.ravel(), keys.world_from_cam("wrist"): pose.ravel()}
        source.add_frame(frame | calibration | {"task": "nothing"})
    source.save_episode()
    source.finalize()
    config = views_config(
        tmp_path / "wrist", tmp_path / "derived", camera="wrist", views=["reproj"], size=None, reproj=view
    )
    result = add_views(config)
    colors = np.rint(255 * images_of(result, keys.view("wrist", "reproj"))).astype(np.uint8).transpose(0, 2, 3, 1)
    heights = images_of(result, keys.view("wrist", "reproj_height"))[:, 0]
    for index, images in enumerate(expected):
        np.testing.assert_array_equal(colors[index], images["reproj"])
        np.testing.assert_array_equal(heights[index], images["reproj_height"])
        assert index == 0 or (colors[index] != colors[index - 1]).any()


def record_real_robot(folder, camera, rgb, use_videos=False):
    """Write three frames with joint angles and depth in uint16 millimetres, as a RealSense gives it; return that."""
    size = (camera.height, camera.width)
    joints = {"dtype": "float32", "shape": (6,), "names": [f"joint_{i}" for i in range(6)]}
    kind, axes = "video" if use_videos else "image", ["height", "width", "channels"]
    source = LeRobotDataset.create(
        "test/real",
        fps=10,
        root=folder,
        use_videos=use_videos,
        features={
            keys.STATE: joints,
            keys.ACTION: joints,
            keys.rgb("front"): {"dtype": kind, "shape": (*size, 3), "names": axes},
            keys.depth("front"): {
                "dtype": "image",
                "shape": (*size, 1),
                "names": axes,
                "info": {"is_depth_map": True},
            },
        },
    )
    depth = np.rint(1000 * plane_depth(camera, height=0.02)).astype(np.uint16)[..., None]
    rng = np.random.default_rng(0)
    for _ in range(3):
        angles = rng.normal(size=6).astype(np.float32)
        frame = {keys.rgb("front"): rgb, keys.depth("front"): depth, keys.STATE: angles, keys.ACTION: angles}
        source.add_frame(frame | {"task": "nothing"})
    source.save_episode()
    source.finalize()
    return depth


@pytest.mark.parametrize("use_videos", [False, True])
def test_a_real_robots_dataset_needs_a_calibration_file_and_no_more(tmp_path, use_videos):
    camera = Camera(intrinsics_from_fov(0.8, 96, 128), orbit_pose(0.9, 0.4, 0.8, (0.45, 0.0, 0.0)), 96, 128)
    rgb = np.full((96, 128, 3), (200, 100, 50), dtype=np.uint8)
    record_real_robot(tmp_path / "real", camera, rgb, use_videos)
    file = tmp_path / "cameras.json"
    calibration = Calibration({"front": camera}, Workspace(size=0.3))
    file.write_text(json.dumps(plain_calibration(calibration)))
    options = {"reproj": make_view("reproj", clip="none", source_scale=3), "persp": make_view("persp", gripper=False)}
    result = add_views(
        views_config(tmp_path / "real", tmp_path / "derived", camera="front", calibration=file, **options)
    )
    heights = images_of(result, keys.view("front", "reproj_height"))
    np.testing.assert_allclose(heights, 0.02, atol=0.001)
    for name in ("reproj", "persp"):
        color = images_of(result, keys.view("front", name)) * 255
        assert np.abs(color - np.reshape([200, 100, 50], (1, 3, 1, 1))).max() <= (4 if use_videos else 0.01)
    facts = json.loads((result / "meta" / "info.json").read_text())["features"][keys.view("front", "reproj")]["info"]
    assert facts["symview"]["workspace"]["size"] == 0.3
    assert parse_calibration(facts["symview"]["calibration"]).camera("front").height == 96


def test_by_a_calibration_file_online_and_by_the_stored_matrices_views_are_the_same_bits(tmp_path):
    camera = Camera(intrinsics_from_fov(0.83, 96, 128), orbit_pose(0.91, 0.37, 0.81, (0.45, 0.01, 0.0)), 96, 128)
    rgb = np.random.default_rng(0).integers(0, 256, (96, 128, 3), dtype=np.uint8)
    depth = record_real_robot(tmp_path / "real", camera, rgb)
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps(plain_calibration(Calibration({"front": camera}))))
    options = {"reproj": {"size": VIEW_SIZE, "clip": "none"}, "persp": {"size": VIEW_SIZE, "gripper": False}}
    views = {name: make_view(name, **chosen) for name, chosen in options.items()}
    made = add_views(
        views_config(tmp_path / "real", tmp_path / "derived", camera="front", calibration=file, size=None, **views)
    )
    item = LeRobotDataset("test/derived", root=made, depth_output_unit="m")[0]
    matrices = {key: item[key] for key in (keys.intrinsics("front"), keys.world_from_cam("front"))}
    observed = {
        keys.rgb("front"): torch.from_numpy(rgb).permute(2, 0, 1)[None],
        keys.depth("front"): torch.from_numpy(depth).permute(2, 0, 1)[None],
    }
    online = ViewsProcessorStep(options, "front", calibration=plain_calibration(read_calibration(file)))
    recomputed = Frame(rgb, depth[..., 0], stored_camera(*(m.numpy() for m in matrices.values()), 96, 128), Workspace())
    for observation in (dict(observed), observed | matrices):
        images = online.observation(observation)
        for view in views.values():
            for output, again in view.render(recomputed).items():
                key = keys.view("front", output)
                again = again.transpose(2, 0, 1) / np.float32(255) if again.ndim == 3 else again[None]
                np.testing.assert_array_equal(images[key][0].numpy(), item[key].numpy(), err_msg=key)
                np.testing.assert_array_equal(again, item[key].numpy(), err_msg=key)


def test_without_the_grippers_pose_the_flags_that_do_without_are_named(recorded, tmp_path):
    source = tmp_path / "joints"
    shutil.copytree(recorded, source)
    info = json.loads((source / "meta" / "info.json").read_text())
    info["features"][keys.STATE]["names"] = [f"joint_{i}" for i in range(5)]
    (source / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(ValueError, match=r"x, y, z, yaw, aperture among the names.*--reproj\.clip.*--persp\.gripper"):
        add_views(views_config(source, tmp_path / "derived"))
    options = {"reproj": make_view("reproj", clip=0.2), "persp": make_view("persp", gripper=False)}
    add_views(views_config(source, tmp_path / "derived", **options))


def test_a_broken_calibration_names_its_frame(recorded, tmp_path):
    source = tmp_path / "broken"
    shutil.copytree(recorded, source)
    file = next(source.rglob("data/**/*.parquet"))
    table = pq.read_table(file)
    poses = vectors(table, keys.world_from_cam("side")).copy()
    poses[4, 0] += 0.3
    column = pa.FixedSizeListArray.from_arrays(pa.array(poses.ravel()), 16)
    index = table.column_names.index(keys.world_from_cam("side"))
    pq.write_table(table.set_column(index, table.schema.field(index), column), file)
    with pytest.raises(CalibrationError, match=r"episode 0, frame 4, camera 'side': .*not orthonormal"):
        add_views(views_config(source, tmp_path / "derived"))


def test_a_stated_camera_that_sees_too_little_is_refused(recorded, tmp_path):
    camera = Camera(intrinsics_from_fov(0.8, 152, 152), orbit_pose(0.9, 0.4, 0.8, (2.0, 0.0, 0.0)), 152, 152)
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps(plain_calibration(Calibration({"side": camera}))))
    with pytest.raises(
        CalibrationError, match=r"'side' sees 0% of the workspace, .*check the poses in .*cameras\.json"
    ):
        add_views(views_config(recorded, tmp_path / "derived", calibration=file))
    assert list(tmp_path.iterdir()) == [file]


def test_a_recorded_camera_that_sees_too_little_is_warned_of(recorded, tmp_path, caplog):
    with caplog.at_level("WARNING", logger="lerobot_symview.add_views"):
        add_views(views_config(recorded, tmp_path / "derived", workspace=Workspace((0.45, 0.6))))
    assert re.search(r"'side' sees \d+% of the workspace, .*: views will be empty where it sees none", caplog.text)


def test_the_workspace_is_the_flags_then_the_files_then_the_datasets(recorded, tmp_path):
    bare, file = tmp_path / "bare", tmp_path / "cameras.json"
    source = LeRobotDataset("test/recorded", root=recorded)
    calibrations = [key for key in source.meta.features if key.startswith("observation.camera.")]
    modify_features(source, remove_features=calibrations, output_dir=bare, repo_id="test/bare")
    matrices = [source[0][key("side")].numpy() for key in (keys.intrinsics, keys.world_from_cam)]
    camera = stored_camera(*matrices, 152, 152)
    stated, in_file, in_dataset = Workspace((0.5, 0.1), 0.3), Workspace(size=0.35), Workspace()
    made = {}
    for name, data, workspace, more in (
        ("flag", recorded, stated, {"workspace": stated}),
        ("dataset", recorded, in_dataset, {}),
        ("flag_before_file", bare, stated, {"workspace": stated, "calibration": file}),
        ("file", bare, in_file, {"calibration": file}),
    ):
        file.write_text(json.dumps(plain_calibration(Calibration({"side": camera}, in_file))))
        result = add_views(views_config(data, tmp_path / name, views=["persp"], persp=NO_GRIPPER, size=None, **more))
        info = json.loads((result / "meta" / "info.json").read_text())
        facts = info["features"][keys.view("side", "persp")]["info"]["symview"]
        assert parse_workspace(facts["workspace"]) == workspace, name
        made[name] = images_of(result, keys.view("side", "persp"))
    np.testing.assert_array_equal(made["flag"], made["flag_before_file"])
    for name in ("dataset", "file"):
        assert (made[name] != made["flag"]).any()


@pytest.mark.parametrize("views", [[], ["reprojection"]])
def test_unknown_views_are_refused_before_anything_is_read(views):
    with pytest.raises(ValueError, match=r"view"):
        AddViewsConfig(PushedDataset("a/b"), views=views)


@pytest.mark.parametrize("name", ["views", "me/", "a/b/c"])
def test_a_wrong_name_of_the_result_names_its_flag(name):
    with pytest.raises(ValueError, match=f"--new_repo_id must look like user/name, got '{name}'"):
        AddViewsConfig(PushedDataset("a/b"), new_repo_id=name)


@pytest.mark.parametrize("place", ["source/views", "source/meta/views", "source", ".", "link/views"])
def test_source_and_result_do_not_lie_in_each_other(recorded, tmp_path, place):
    source = tmp_path / "source"
    shutil.copytree(recorded, source)
    (tmp_path / "link").symlink_to(source)
    before = contents(tmp_path)
    with pytest.raises(ValueError, match="neither may lie in the other, choose another --new_root"):
        add_views(views_config(source, tmp_path / place))
    assert contents(tmp_path) == before


def test_a_source_is_not_where_the_result_is_made(recorded, tmp_path):
    source = tmp_path / "views.partial" / "source"
    shutil.copytree(recorded, source)
    with pytest.raises(ValueError, match="choose another --new_root"):
        add_views(views_config(source, tmp_path / "views"))


def test_lerobots_own_act_trains_on_what_is_made_for_stock_policies(recorded, tmp_path, monkeypatch):
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


def test_a_camera_may_be_kept_for_stock_policies(recorded, tmp_path):
    config = views_config(recorded, tmp_path / "stock", for_stock_policies=True, views=["reproj"], keep=["side"])
    images = LeRobotDataset("test/stock", root=add_views(config)).meta.camera_keys
    assert set(images) == {keys.rgb("side"), keys.view("side", "reproj")}


def test_a_view_of_one_channel_is_refused_for_stock_policies(monkeypatch):
    @dataclass(frozen=True)
    class Metres:
        size: int = 8
        outputs = {"metres": "height"}  # noqa: RUF012

    monkeypatch.setitem(VIEWS, "metres", Metres)
    AddViewsConfig(PushedDataset("a/b"), views=["metres"])
    with pytest.raises(ValueError, match="the view 'metres' has one in metres: take it out of --views"):
        AddViewsConfig(PushedDataset("a/b"), views=["metres"], for_stock_policies=True)


@pytest.mark.parametrize("file", ["meta/stats.json", "data/chunk-000/file-000.parquet"])
def test_a_file_that_the_source_lacks_is_named_before_any_work(recorded, tmp_path, file):
    source = tmp_path / "source"
    shutil.copytree(recorded, source)
    (source / file).unlink()
    with pytest.raises(CommandError, match=rf"dataset in .* lacks {file}: download or copy it again"):
        add_views(views_config(source, tmp_path / "never"))
    assert list(tmp_path.iterdir()) == [source]
