import logging
import re
import sys

import cv2
import numpy as np
import pytest
import yaml
from lerobot.datasets import LeRobotDataset, merge_datasets

from lerobot_symview.calibration.file import Calibration, plain_calibration
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.datasets.add_views import add_views
from lerobot_symview.datasets.source import SourceDataset
from lerobot_symview.errors import CalibrationError, SymviewError
from lerobot_symview.geometry.camera import Camera, intrinsics_from_fov, orbit_pose
from lerobot_symview.geometry.lens import EQUIDISTANT, Lens
from lerobot_symview.geometry.placement import CameraSpec, CameraSpread
from lerobot_symview.geometry.undistortion import undistorted
from lerobot_symview.geometry.visibility import table_resolution
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import DatasetLocation
from lerobot_symview.views import Frame, make_view
from symview_eval.contact_sheet import OUTLINE, png_uri, with_outline
from symview_eval.preview import PreviewConfig, main, preview, read_samples
from symview_eval.rerun_recording import RerunRecording
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset
from tests.helpers.boards import K, pose_errors
from tests.helpers.cameras import make_camera, plane_depth
from tests.helpers.datasets import in_mm, record_real_robot, views_config
from tests.helpers.fakecamera import FakeCamera
from tests.helpers.tables import TABLE, textured_table


def config(source, folder, **options):
    return PreviewConfig(DatasetLocation("test/shown", source), output_dir=folder, **({"rerun": False} | options))


def test_views_are_computed_for_a_dataset_without_them(recorded, tmp_path):
    page = (preview(config(recorded, tmp_path, episodes=[0, 1], frames=2)) / "preview.html").read_text()
    for name in ("side and workspace", "top", "side_reproj", "side_reproj_height", "side_reproj_seen", "side_persp"):
        assert page.count(f"<figcaption>{name}</figcaption>") == 4
    assert "side_depth" not in page
    assert "episode 1, frame 6" in page
    assert "45° elevation, 0° azimuth, 0.81 m" in page


def test_a_dataset_of_views_only_shows_its_images(only_views, tmp_path):
    page = (preview(config(only_views, tmp_path, frames=1)) / "preview.html").read_text()
    assert page.count("<figcaption>") == 2
    assert "<figcaption>side_reproj</figcaption>" in page


def test_stored_views_are_shown(with_views, tmp_path, caplog):
    (sample,) = read_samples(SourceDataset(with_views), None, 0, [0])
    with caplog.at_level(logging.WARNING, logger="symview_eval.preview"):
        page = (preview(config(with_views, tmp_path, frames=1)) / "preview.html").read_text()
    assert caplog.text == ""
    for name in ("side_reproj", "side_persp", "side_persp_gripper"):
        assert f'<figcaption>{name}</figcaption><img src="{png_uri(sample.stored[name])}"' in page
    assert "side_reproj_seen" not in page
    assert "<figcaption>side and workspace</figcaption>" in page


@pytest.mark.parametrize("options", [{"views": ["reproj"]}, {"reproj": make_view("reproj", infill="none")}])
def test_requested_views_are_computed_and_shown_with_the_stored_ones(with_views, tmp_path, options):
    (sample,) = read_samples(SourceDataset(with_views), None, 0, [0])
    page = (preview(config(with_views, tmp_path, frames=1, **options)) / "preview.html").read_text()
    assert f'<figcaption>side_reproj, stored</figcaption><img src="{png_uri(sample.stored["side_reproj"])}"' in page
    assert page.count("<figcaption>side_reproj, computed</figcaption>") == 1
    assert page.count("<figcaption>side_reproj_seen</figcaption>") == 1
    assert page.count("<figcaption>side_persp</figcaption>") == 1


def test_a_given_workspace_is_shown_and_measured(recorded, with_views, tmp_path, caplog):
    with caplog.at_level(logging.WARNING, logger="symview_eval.preview"):
        preview(config(recorded, tmp_path / "elsewhere", frames=1, workspace=Workspace((0.45, 0.3))))
    assert "of the workspace, less than 60%: move or rotate the camera" in caplog.text
    smaller = config(with_views, tmp_path / "smaller", frames=1, workspace=Workspace(size=0.3))
    assert "<figcaption>side_reproj, computed</figcaption>" in (preview(smaller) / "preview.html").read_text()


def test_a_view_that_is_not_stored_is_computed(recorded, tmp_path):
    source = add_views(views_config(recorded, tmp_path / "persp", views=["persp"]))
    page = (preview(config(source, tmp_path / "preview", frames=1)) / "preview.html").read_text()
    for name in ("side_persp", "side_reproj", "side_reproj_seen"):
        assert page.count(f"<figcaption>{name}</figcaption>") == 1


def test_warnings_about_holes_and_resolution(recorded, tmp_path, caplog):
    with caplog.at_level(logging.WARNING, logger="symview_eval.preview"):
        preview(config(recorded, tmp_path / "coarse", frames=1, size=400))
        assert "of the pixels of side_reproj are inferred, more than --max_holes=0.85: lower --size, or" in caplog.text
        assert re.search(
            r"view reproj draws 1.00 px/mm, camera side resolves 0.\d+ at worst: use --size=76", caplog.text
        )
        caplog.clear()
        preview(config(recorded, tmp_path / "fine", frames=1))  # the paper's camera and size
        assert caplog.text == ""


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"episodes": [7]}, SymviewError, r"--episodes names \[7\], the dataset has 2 episodes"),
        ({"camera": "front", "views": ["persp"]}, ValueError, "no camera 'front'"),
    ],
)
def test_an_unknown_episode_or_camera_is_refused(recorded, tmp_path, options, error, message):
    with pytest.raises(error, match=message):
        preview(config(recorded, tmp_path, **options))


@pytest.mark.parametrize(("option", "value"), [("frames", 0), ("episodes", []), ("max_holes", 2.0)])
def test_invalid_options_are_refused(option, value):
    with pytest.raises(ValueError, match=f"--{option}"):
        PreviewConfig(DatasetLocation("a/b"), **{option: value})


def test_samples_are_read_from_their_rows(recorded):
    source = SourceDataset(recorded)
    first, later = read_samples(source, None, 1, [0, 5])
    assert first.title == "episode 1, frame 0"
    assert set(first.stored) == {"side", "side_depth", "top", "top_depth"}
    assert (first.stored["side"] != later.stored["side"]).any()


def test_table_resolution_of_a_top_down_camera():
    distance, pixels = 0.8, 200
    intrinsics = intrinsics_from_fov(np.deg2rad(50), pixels, pixels)
    camera = Camera(intrinsics, orbit_pose(np.pi / 2, 0.0, distance, (0.45, 0.0, 0.0)), pixels, pixels)
    assert table_resolution(camera, Workspace()) == pytest.approx(intrinsics[0, 0] / distance / 1000, rel=1e-3)


def test_table_resolution_decreases_with_the_elevation():
    resolutions = [table_resolution(make_camera(elevation), Workspace()) for elevation in (75, 45, 15)]
    assert resolutions == sorted(resolutions, reverse=True)


def test_the_outline_passes_through_the_workspace_corners():
    camera = make_camera(45.0)
    drawn = with_outline(np.zeros((152, 152, 3), dtype=np.uint8), camera, Workspace())
    from lerobot_symview.geometry.camera import project

    scale = drawn.shape[0] // 152
    for u, v in project(Workspace().corners(), camera)[0]:
        column, row = (np.array([u, v]) + 0.5) * scale
        patch = drawn[int(row) - 3 : int(row) + 4, int(column) - 3 : int(column) + 4]
        assert (patch == OUTLINE).all(axis=-1).any()


def test_a_recording_has_cameras_points_and_computed_views(recorded, tmp_path):
    from rerun.experimental import RrdReader

    preview(config(recorded, tmp_path, frames=2, rerun=True))
    paths = {chunk.entity_path for chunk in RrdReader(tmp_path / "preview.rrd").stream()}
    assert {"/world/side", "/world/side/image", "/world/points", "/world/workspace"} <= paths
    assert {f"/views/side_{name}" for name in ("reproj", "reproj_height", "reproj_seen", "persp")} <= paths


def test_a_recording_has_points_and_stored_views(with_views, tmp_path):
    from rerun.experimental import RrdReader

    preview(config(with_views, tmp_path, frames=1, rerun=True))
    paths = {chunk.entity_path for chunk in RrdReader(tmp_path / "preview.rrd").stream()}
    assert {"/world/points", "/views/side_reproj", "/views/side_reproj_height", "/views/side_persp"} <= paths


def test_a_recording_shows_the_image_without_the_distortion_of_the_lens(tmp_path):
    from rerun.experimental import RrdReader

    camera = Camera(K, orbit_pose(0.8, 0.3, 0.9, TABLE), 480, 640, Lens(EQUIDISTANT, (0.05, -0.01, 0.002, 0.0)))
    rgb = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    recording = RerunRecording(tmp_path / "preview.rrd", Workspace())
    recording.add(0, "front", Frame(rgb, None, camera, Workspace(), None), {})
    recording.close()
    columns = {
        name: batch.column(name)
        for chunk in RrdReader(tmp_path / "preview.rrd").stream()
        if chunk.entity_path == "/world/front/image"
        for batch in [chunk.to_record_batch()]
        for name in batch.schema.names
    }
    shown = np.array(columns["Image:buffer"][0].as_py()).reshape(rgb.shape)
    np.testing.assert_array_equal(shown, undistorted(rgb, camera))


def turned(pixels):
    """The camera of `record_moving`, turned so that its image moves by some pixels."""
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.array([0.0, np.arctan(pixels / K[0, 0]), 0.0]))[0]
    return Camera(K, orbit_pose(0.8, 0.3, 0.9, TABLE) @ turn, 480, 640)


def record_moving(folder, turns_px):
    """Record one-frame episodes of a robot with a camera that turns by some pixels before each of them."""
    before = turned(0)
    depth = in_mm(plane_depth(before))
    for episode, pixels in enumerate(turns_px):
        rgb = textured_table(turned(pixels), seed=episode)
        record_real_robot(folder / str(episode), rgb, depth, depth_unit="mm")
    datasets = [LeRobotDataset("test/part", root=folder / str(episode)) for episode in range(len(turns_px))]
    merge_datasets(datasets, output_repo_id="test/moving", output_dir=folder / "merged")
    file = folder / "cameras.yaml"
    file.write_text(yaml.safe_dump(plain_calibration(Calibration({"front": before}))))
    return folder / "merged", file, before


def test_a_camera_that_moves_by_three_pixels_is_found_and_its_pose_is_written(tmp_path, caplog):
    folder, file, before = record_moving(tmp_path, [0, 0, 3, 3])
    with caplog.at_level(logging.INFO):
        preview(config(folder, tmp_path / "out", camera="front", calibration=file, check=True))
    (warning,) = [record.getMessage() for record in caplog.records if "was moved" in record.getMessage()]
    assert re.search(
        r"camera 'front' was moved since episode 0: its image by (2\.[7-9]|3\.[0-4]) pixels \(up to \d", warning
    )
    assert "in the episodes 2, 3" in warning
    now = read_calibration(tmp_path / "out" / "cameras.yaml").camera("front")
    turn = np.rad2deg(np.arctan(3 / K[0, 0]))
    assert pose_errors(before, now.world_from_cam)[0] == pytest.approx(turn, abs=0.05)


def test_a_camera_that_stands_still_is_said_to(tmp_path, caplog):
    folder, file, _ = record_moving(tmp_path, [0, 0])
    with caplog.at_level(logging.INFO):
        preview(config(folder, tmp_path / "out", camera="front", calibration=file, check=True))
    assert re.search(r"camera 'front' stands still: its image moves by at most 0\.\d pixels", caplog.text)
    assert not (tmp_path / "out" / "cameras.yaml").exists()


def test_a_camera_of_another_pose_in_every_episode_is_not_compared(tmp_path, caplog):
    env = RecordedEnv(camera=CameraSpec(spread=CameraSpread(azimuth_deg=90.0)), oracle=False)
    source = generate(GenerateConfig(NewDataset("test/spread", tmp_path / "spread"), env=env, num_episodes=2))
    with caplog.at_level(logging.INFO):
        preview(config(source, tmp_path / "out", check=True))
    assert "every episode has a calibration of its own" in caplog.text


def test_a_camera_of_lerobot_is_compared_with_the_dataset(tmp_path, monkeypatch, caplog, capsys):
    folder, file, before = record_moving(tmp_path, [0])
    monkeypatch.setattr(FakeCamera, "see", lambda pixels: textured_table(turned(pixels), seed=9), raising=False)
    flags = ["--dataset.repo_id=test/moving", f"--dataset.root={folder}", f"--calibration={file}", "--camera=front"]
    flags += [f"--output_dir={tmp_path / 'out'}", "--rerun=false", "--device.type=fake"]

    def check(*more):
        caplog.clear()
        monkeypatch.setattr(sys, "argv", ["symview-preview", *flags, *more])
        with caplog.at_level(logging.INFO, logger="symview_eval"), pytest.raises(SystemExit) as end:
            main()
        return end.value.code, capsys.readouterr().err.splitlines()[-1:], caplog.text

    code, _, log = check("--check=true")
    assert code == 0
    assert re.search(r"camera 'front' stands still: the live image is shifted by 0\.\d pixels", log)
    assert not (tmp_path / "out" / "cameras.yaml").exists()
    code, _, log = check("--check=true", "--device.position=5")
    assert code == 0
    assert re.search(r"was moved since episode 0: the live image is shifted by (4\.[7-9]|5\.[0-3]) pixels", log)
    now = read_calibration(tmp_path / "out" / "cameras.yaml").camera("front")
    assert pose_errors(before, now.world_from_cam)[0] == pytest.approx(np.rad2deg(np.arctan(5 / K[0, 0])), abs=0.05)
    code, error, _ = check()
    assert code == 2
    assert error == [
        "symview-preview: error: --device takes an image to compare with the dataset: give --check=true beside it"
    ]
    monkeypatch.setattr(FakeCamera, "see", lambda _: np.zeros((720, 1280, 3), np.uint8))
    code, (error,), _ = check("--check=true")
    assert code == 1
    assert error.endswith("of camera 'front' have 640 x 480: give --device.width=640 --device.height=480")
    monkeypatch.setattr(FakeCamera, "see", lambda _: np.zeros((480, 640, 3), np.uint8))
    code, (error,), _ = check("--check=true")
    assert code == 2
    assert error.startswith("symview-preview: error: --device: the live image cannot be compared with episode 0: ")


def test_a_dataset_of_views_alone_cannot_be_checked(only_views, tmp_path):
    with pytest.raises(ValueError, match="--check, --check_image and --device need the camera's images"):
        preview(config(only_views, tmp_path, check=True))


def test_an_image_of_today_tells_whether_the_camera_was_moved(tmp_path, caplog):
    folder, file, before = record_moving(tmp_path, [0, 0])
    images = {
        "same.png": textured_table(before, seed=7),
        "moved.png": textured_table(turned(4), seed=8),
        "black.png": np.zeros((480, 640, 3), np.uint8),
    }
    written = tmp_path / "out" / "cameras.yaml"
    for name, image in images.items():
        cv2.imwrite(str(tmp_path / name), image[..., ::-1])
    options = {"camera": "front", "calibration": file}

    def check(name):
        caplog.clear()
        with caplog.at_level(logging.INFO):
            preview(config(folder, tmp_path / "out", check_image=tmp_path / name, **options))
        return caplog.text

    still = re.compile(r"camera 'front' stands still: same\.png is shifted by 0\.\d pixels")
    moved = re.compile(r"was moved since episode 0: moved\.png is shifted by (3\.[7-9]|4\.[0-4]) pixels")
    assert still.search(check("same.png"))
    assert not written.exists()
    assert moved.search(check("moved.png"))
    now = read_calibration(written).camera("front")
    assert pose_errors(before, now.world_from_cam)[0] == pytest.approx(np.rad2deg(np.arctan(4 / K[0, 0])), abs=0.05)
    with pytest.raises(CalibrationError, match=r"--check_image: .*black\.png cannot be compared with episode 0"):
        check("black.png")
    with pytest.raises(ValueError, match=r"--check_image must be an image file, got .*missing\.png"):
        config(folder, tmp_path, check_image=tmp_path / "missing.png")
    with pytest.raises(ValueError, match="give one of them"):
        config(folder, tmp_path, check=True, check_image=tmp_path / "same.png")
