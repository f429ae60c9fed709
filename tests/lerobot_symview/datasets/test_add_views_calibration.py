"""Calibration of a dataset's views: stored with its frames, for fixed and moving cameras, or read from a file."""

import json
import re
import shutil
from dataclasses import asdict

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
import yaml
from lerobot.datasets import LeRobotDataset, modify_features

from lerobot_policy_symview.processor_views import ViewsProcessorStep
from lerobot_symview import keys, reproject
from lerobot_symview.calibration.file import Calibration, parse_calibration, parse_workspace, plain_calibration
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.datasets.add_views import add_views
from lerobot_symview.datasets.features import camera_features
from lerobot_symview.datasets.metadata import ADDED_VIEWS, read_settings
from lerobot_symview.datasets.source import vectors
from lerobot_symview.errors import CalibrationError, DatasetError
from lerobot_symview.geometry.camera import Camera, intrinsics_from_fov, orbit_pose, stored_camera
from lerobot_symview.geometry.placement import CameraSpec, CameraSpread
from lerobot_symview.geometry.units import in_metres
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import VIEWS, Frame, ViewSpec, make_view
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset
from tests.conftest import VIEW_SIZE
from tests.helpers.cameras import plane_depth
from tests.helpers.datasets import images_of, in_mm, record_real_robot, views_config

NO_GRIPPER = make_view("persp", size=VIEW_SIZE, gripper=False)


@pytest.mark.long
def test_calibration_from_a_file_gives_the_same_views(recorded, with_views, tmp_path):
    """A dataset without calibration gets the same views with a calibration file; the result stores the calibration."""
    source = LeRobotDataset("test/recorded", root=recorded)
    calibrations = [key for key in source.meta.features if key.startswith("observation.camera.")]
    matrices = {key: source[0][key].tolist() for key in calibrations}
    modify_features(source, remove_features=calibrations, output_dir=tmp_path / "bare", repo_id="test/bare")
    with pytest.raises(
        DatasetError, match=r"--calibration: .*lacks observation\.camera.*cameras with calibration: none"
    ):
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
    with pytest.raises(ValueError, match=r"already has observation\.camera\.side\.intrinsics"):
        add_views(views_config(recorded, tmp_path / "never", calibration=file))
    file.write_text(yaml.safe_dump({"units": "m", "cameras": {"side": side | {"height": 76, "width": 76}}}))
    with pytest.raises(CalibrationError, match=r"principal point|152 x 152"):
        add_views(views_config(tmp_path / "bare", tmp_path / "never", calibration=file))
    assert not list(tmp_path.glob("never*"))


def test_a_camera_that_moves_between_episodes_is_followed(tmp_path):
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
    """Every frame is reprojected with its own pose, as for a wrist camera."""
    source = LeRobotDataset.create(
        "test/wrist",
        fps=10,
        root=tmp_path / "wrist",
        use_videos=False,
        features=camera_features("wrist", 48, 64, Workspace())
        | {keys.ACTION: {"dtype": "float32", "shape": (1,), "names": None}},
    )
    rng, expected = np.random.default_rng(0), []
    view = make_view("reproj", size=32, clip="none")
    for azimuth in np.linspace(0, 2, 6):
        pose = orbit_pose(0.8, azimuth, 0.6 + 0.1 * azimuth, (0.45, 0.0, 0.0)).astype(np.float32)
        intrinsics = intrinsics_from_fov(0.9, 48, 64).astype(np.float32)
        camera = stored_camera(intrinsics.ravel(), pose.ravel(), 48, 64)
        rgb = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
        depth = plane_depth(camera).astype(np.float32)
        expected.append(view.render(Frame(rgb, depth, camera, Workspace())))
        frame = {keys.rgb("wrist"): rgb, keys.depth("wrist"): depth[..., None], keys.ACTION: np.zeros(1, np.float32)}
        calibration = {keys.intrinsics("wrist"): intrinsics.ravel(), keys.world_from_cam("wrist"): pose.ravel()}
        source.add_frame(frame | calibration | {"task": "none"})
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


@pytest.mark.parametrize("use_videos", [False, True])
def test_a_real_robot_dataset_needs_only_a_calibration_file(tmp_path, use_videos):
    camera = Camera(intrinsics_from_fov(0.8, 96, 128), orbit_pose(0.9, 0.4, 0.8, (0.45, 0.0, 0.0)), 96, 128)
    rgb = np.full((96, 128, 3), (200, 100, 50), dtype=np.uint8)
    record_real_robot(tmp_path / "real", rgb, in_mm(plane_depth(camera, height=0.02)), use_videos)
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
    info = json.loads((result / "meta" / "info.json").read_text())
    assert info["features"][keys.view("front", "reproj")]["info"]["symview"]["workspace"]["size"] == 0.3
    made_with = read_settings(result, ADDED_VIEWS)
    assert parse_calibration(made_with["calibration"]).camera("front").height == 96


def test_views_are_bit_identical_offline_online_and_from_stored_matrices(tmp_path):
    camera = Camera(intrinsics_from_fov(0.83, 96, 128), orbit_pose(0.91, 0.37, 0.81, (0.45, 0.01, 0.0)), 96, 128)
    rgb = np.random.default_rng(0).integers(0, 256, (96, 128, 3), dtype=np.uint8)
    depth = in_mm(plane_depth(camera, height=0.02))
    record_real_robot(tmp_path / "real", rgb, depth)
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps(plain_calibration(Calibration({"front": camera}))))
    views = {
        "reproj": make_view("reproj", size=VIEW_SIZE, clip="none"),
        "persp": make_view("persp", size=VIEW_SIZE, gripper=False),
    }
    specs = [ViewSpec(name, asdict(view)).plain() for name, view in views.items()]
    made = add_views(
        views_config(tmp_path / "real", tmp_path / "derived", camera="front", calibration=file, size=None, **views)
    )
    item = LeRobotDataset("test/derived", root=made, depth_output_unit="m")[0]
    matrices = {key: item[key] for key in (keys.intrinsics("front"), keys.world_from_cam("front"))}
    observed = {
        keys.rgb("front"): torch.from_numpy(rgb).permute(2, 0, 1)[None],
        keys.depth("front"): torch.from_numpy(depth)[None, None],
    }
    online = ViewsProcessorStep(specs, "front", calibration=plain_calibration(read_calibration(file)))
    recomputed = Frame(
        rgb, in_metres(depth), stored_camera(*(m.numpy() for m in matrices.values()), 96, 128), Workspace()
    )
    for observation in (dict(observed), observed | matrices):
        images = online.observation(observation)
        for view in views.values():
            for output, again in view.render(recomputed).items():
                key = keys.view("front", output)
                again = again.transpose(2, 0, 1) / np.float32(255) if again.ndim == 3 else again[None]
                np.testing.assert_array_equal(images[key][0].numpy(), item[key].numpy(), err_msg=key)
                np.testing.assert_array_equal(again, item[key].numpy(), err_msg=key)


def test_an_invalid_pose_error_names_its_frame(recorded, tmp_path):
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


def test_a_calibration_file_that_misses_the_workspace_is_rejected(recorded, tmp_path):
    camera = Camera(intrinsics_from_fov(0.8, 152, 152), orbit_pose(0.9, 0.4, 0.8, (2.0, 0.0, 0.0)), 152, 152)
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps(plain_calibration(Calibration({"side": camera}))))
    with pytest.raises(
        CalibrationError,
        match=r"--calibration=.*cameras\.json: camera 'side' sees 0% of the workspace, .*check its pose",
    ):
        add_views(views_config(recorded, tmp_path / "derived", calibration=file))
    assert list(tmp_path.iterdir()) == [file]


def test_a_recorded_camera_that_misses_the_workspace_logs_a_warning(recorded, tmp_path, caplog):
    with caplog.at_level("WARNING", logger="lerobot_symview.datasets.add_views"):
        add_views(views_config(recorded, tmp_path / "derived", workspace=Workspace((0.45, 0.3))))
    assert re.search(r"'side' sees \d+ % of the workspace: views will be empty outside its image", caplog.text)


@pytest.mark.long
def test_the_workspace_flag_overrides_the_file_and_the_dataset(recorded, tmp_path):
    bare, file = tmp_path / "bare", tmp_path / "cameras.json"
    source = LeRobotDataset("test/recorded", root=recorded)
    calibrations = [key for key in source.meta.features if key.startswith("observation.camera.")]
    modify_features(source, remove_features=calibrations, output_dir=bare, repo_id="test/bare")
    matrices = [source[0][key("side")].numpy() for key in (keys.intrinsics, keys.world_from_cam)]
    camera = stored_camera(*matrices, 152, 152)
    in_flag, in_file, in_dataset = Workspace((0.5, 0.1), 0.3), Workspace(size=0.35), Workspace()
    made = {}
    for name, data, workspace, more in (
        ("flag", recorded, in_flag, {"workspace": in_flag}),
        ("dataset", recorded, in_dataset, {}),
        ("flag_before_file", bare, in_flag, {"workspace": in_flag, "calibration": file}),
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


DEPTH_SENSOR = {
    "intrinsics": [70.0, 70.0, 47.5, 35.5],
    "color_from_depth": [[1, 0, 0, 15.0], [0, 1, 0, -4.0], [0, 0, 1, 2.0]],
}


def unaligned(tmp_path):
    """Record an RGBD camera whose depth has another size and place; return folder, calibration file, and images."""
    color = CameraSpec(height=120, width=160).place(Workspace())
    rgb = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    pose = color.world_from_cam.copy()
    pose[:3, 3] *= 1000
    front = {"height": 120, "width": 160, "intrinsics": color.intrinsics.tolist(), "world_from_cam": pose.tolist()}
    file = tmp_path / "cameras.yaml"
    file.write_text(yaml.safe_dump({"units": "mm", "cameras": {"front": front | {"depth_sensor": DEPTH_SENSOR}}}))
    camera = read_calibration(file).camera("front")
    depth = in_mm(plane_depth(camera.depth_camera(72, 96), 0.0))
    record_real_robot(tmp_path / "robot", rgb, depth, depth_unit="mm")
    return tmp_path / "robot", file, camera, rgb, depth


def test_depth_of_a_sensor_of_its_own_is_registered_offline_and_online(tmp_path):
    folder, file, camera, rgb, depth = unaligned(tmp_path)
    assert camera.depth_sensor.color_from_depth[:3, 3] == pytest.approx([0.015, -0.004, 0.002])
    options = {"camera": "front", "views": ["reproj"], "size": 64}
    result = add_views(views_config(folder, tmp_path / "views", calibration=file, **options))
    expected = reproject(rgb, depth, camera, Workspace(), size=64)
    dataset = LeRobotDataset("test/views", root=result, depth_output_unit="m")
    shown = (dataset[0][keys.view("front", "reproj")] * 255).round().byte().permute(1, 2, 0).numpy()
    np.testing.assert_array_equal(shown, expected.rgb)
    assert dataset[0][keys.depth_intrinsics("front")].tolist() == pytest.approx([70, 0, 47.5, 0, 70, 35.5, 0, 0, 1])
    item = dataset[0]
    for calibration in (plain_calibration(read_calibration(file)), {}):  # from the step, and from the observation
        needed = [keys.rgb("front"), keys.depth("front"), keys.STATE]
        needed += [] if calibration else keys.calibration("front", item)
        step = ViewsProcessorStep(
            [{"name": "reproj", "size": 64}], "front", calibration=calibration, gripper=[],
            depth_units={keys.depth("front"): "m"},
        )  # fmt: skip
        online = step.observation({key: item[key][None] for key in needed})[keys.view("front", "reproj")]
        np.testing.assert_array_equal((online[0] * 255).round().byte().permute(1, 2, 0).numpy(), expected.rgb)
    masked = options | {"views": [{"name": "persp", "size": 64}, {"name": "reproj", "size": 64}]}
    removed = [keys.view("front", output) for output in ("reproj", "reproj_height")]
    modify_features(dataset, remove_features=removed, output_dir=tmp_path / "columns", repo_id="test/columns")
    again = add_views(views_config(tmp_path / "columns", tmp_path / "again", new_repo_id="test/again", **masked))
    np.testing.assert_array_equal(
        images_of(again, keys.view("front", "reproj")), images_of(result, keys.view("front", "reproj"))
    )


def test_the_unit_of_a_depth_sensor_is_told_by_the_table(tmp_path):
    """The sensor's own pose shows the table at z = 0 in the right unit only."""
    _, file, camera, rgb, depth = unaligned(tmp_path)
    step = ViewsProcessorStep(
        [{"name": "reproj", "size": 64}], "front", calibration=plain_calibration(read_calibration(file)), gripper=[]
    )
    tenths = torch.from_numpy((depth * 10.0).astype(np.float32))[None, None]  # of a millimetre
    color = torch.from_numpy(rgb).permute(2, 0, 1)[None]
    view = step.observation({keys.rgb("front"): color, keys.depth("front"): tenths})[keys.view("front", "reproj")]
    expected = reproject(rgb, depth, camera, Workspace(), size=64).rgb
    shown = (view[0] * 255).round().byte().permute(1, 2, 0).numpy()
    assert (shown == expected).all(axis=-1).mean() > 0.99  # metres round differently


def test_depth_of_another_size_without_a_sensor_names_the_remedy(tmp_path):
    folder, file, *_ = unaligned(tmp_path)
    content = yaml.safe_load(file.read_text())
    del content["cameras"]["front"]["depth_sensor"]
    file.write_text(yaml.safe_dump(content))
    config = views_config(folder, tmp_path / "never", calibration=file, camera="front", views=["reproj"])
    with pytest.raises(DatasetError, match=r"72 x 96 pixels, .* 120 x 160: give the depth sensor's calibration"):
        add_views(config)


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        ({"intrinsics": [70, 70, 47.5, 35.5]}, "depth_sensor: expected one of color_from_depth, position, got none"),
        (DEPTH_SENSOR | {"size": 3}, "depth_sensor: it has unknown keys: size"),
        ([1, 2], "depth_sensor must be a mapping"),
        (
            DEPTH_SENSOR | {"color_from_depth": np.diag([1.0, 1, 1, 1]).tolist(), "intrinsics": [70, 70]},
            "intrinsics must be",
        ),
    ],
)
def test_a_wrong_depth_sensor_in_a_file_is_refused(sensor, message):
    front = {"height": 120, "width": 160, "intrinsics": [150.0, 150, 79.5, 59.5]}
    front["world_from_cam"] = CameraSpec().place(Workspace()).world_from_cam.tolist()
    with pytest.raises(CalibrationError, match=message):
        parse_calibration({"units": "m", "cameras": {"front": front | {"depth_sensor": sensor}}})


@pytest.mark.parametrize("depth_video", [False, True], ids=["images", "video"])
def test_pixels_without_depth_become_no_points(tmp_path, depth_video):
    """LeRobot's depth videos clip an invalid 0 to their minimum, 1 cm: a point at the camera, above everything."""
    camera = CameraSpec(elevation_deg=89.0, height=96, width=96).place(Workspace())
    depth = in_mm(plane_depth(camera, 0.02))
    depth[:, 48:] = 0
    record_real_robot(
        tmp_path / "robot", np.full((96, 96, 3), 90, np.uint8), depth, depth_video=depth_video, depth_unit="mm"
    )
    front = {"height": 96, "width": 96, "intrinsics": camera.intrinsics, "world_from_cam": camera.world_from_cam}
    file = tmp_path / "cameras.yaml"
    numbers = {key: np.asarray(value).tolist() for key, value in front.items()}
    file.write_text(yaml.safe_dump({"units": "m", "cameras": {"front": numbers}}))
    view = {"name": "reproj", "size": 48, "clip": "none", "infill": "none", "mask": True}
    result = add_views(
        views_config(tmp_path / "robot", tmp_path / "views", calibration=file, camera="front", views=[view])
    )
    heights = images_of(result, keys.view("front", "reproj_height"))
    seen = images_of(result, keys.view("front", "reproj_seen"))[:, :1] > 0
    assert 0.2 < seen.mean() < 0.6
    assert np.abs(heights[seen] - 0.02).max() < 0.01
    dataset = LeRobotDataset("test/robot", root=tmp_path / "robot")  # as training reads it: millimetres
    step = ViewsProcessorStep(
        [view], "front", calibration=plain_calibration(read_calibration(file)), gripper=[],
        depth_units={keys.depth("front"): "mm"},
    )  # fmt: skip
    observed = {key: dataset[0][key][None] for key in (keys.rgb("front"), keys.depth("front"))}
    online = step.observation(observed)[keys.view("front", "reproj_seen")]
    assert ((online[0, 0] > 0.5).numpy() == seen[0, 0]).mean() > 0.97
