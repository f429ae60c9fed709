"""`symview-calibrate` in this process, on rendered photographs, datasets and a fake camera."""

import logging
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image

from lerobot_symview import keys
from lerobot_symview.calibration.board import Board
from lerobot_symview.calibration.file import Calibration, plain_calibration
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.datasets.source import EpisodeTables, SourceDataset, vectors
from lerobot_symview.geometry.camera import Camera, stored_camera, to_ideal
from lerobot_symview.geometry.lens import EQUIDISTANT, Lens
from lerobot_symview.geometry.workspace import Workspace
from symview_eval.calibrate import command
from tests.helpers.boards import K, camera_over, close_views, photograph, pose_errors
from tests.helpers.cameras import plane_depth
from tests.helpers.fakecamera import FakeCamera
from tests.lerobot_symview.calibration.formats import files

pytestmark = pytest.mark.long

INTRINSICS = "--intrinsics=615.3,615.1,319.5,239.5"
DISTORTION = (-0.2, 0.08, 0.001, -0.0005)
CAMERA = camera_over(Board(), 50, 30, 0.8)


@pytest.fixture
def run(monkeypatch, tmp_path, caplog, capsys):
    """Run the command in an empty folder; return its exit code, its error and its log."""
    monkeypatch.chdir(tmp_path)

    def run(*flags):
        monkeypatch.setattr(sys, "argv", ["symview-calibrate", *flags])
        caplog.clear()
        with caplog.at_level(logging.INFO, logger="lerobot_symview"), pytest.raises(SystemExit) as end:
            command.main()
        return end.value.code, capsys.readouterr().err, caplog.text

    return run


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A folder with one photograph of the board on the table, and twelve from nearby, all distorted."""
    folder = tmp_path_factory.mktemp("photos")
    for index, camera in enumerate([CAMERA, *close_views(Board())]):
        save(folder / f"{index:02d}.png", photograph(Board(), camera, DISTORTION, seed=index))
    return folder


@pytest.fixture
def photo(tmp_path):
    return save(tmp_path / "photo.png", photograph(Board(), CAMERA))


def save(file, image):
    Image.fromarray(image).save(file)
    return file


def test_a_photograph_gives_a_calibration_and_a_picture(run, photo, tmp_path):
    code, error, log = run(f"--images={photo}", INTRINSICS)
    assert (code, error) == (0, "")
    calibration = read_calibration("cameras.yaml")
    degrees, millimetres = pose_errors(CAMERA, calibration.camera("front").world_from_cam)
    assert degrees < 0.1
    assert millimetres < 1
    assert calibration.workspace == Workspace(center=(0.12, 0.08))
    assert "15 corners, reprojection error 0.0" in log
    assert "mm on the table" in log
    picture = np.asarray(Image.open("cameras_front.png"))
    assert picture.shape == (960, 1280, 3)
    for color in [(255, 60, 0), (255, 190, 0), (230, 0, 0), (0, 160, 0), (0, 90, 255), (255, 0, 255)]:
        assert (picture == color).all(axis=-1).sum() > 50
    assert sorted(file.name for file in tmp_path.iterdir()) == ["cameras.yaml", "cameras_front.png", "photo.png"]


def test_the_board_is_placed_by_flags(run, tmp_path):
    place = {"origin": (0.35, -0.1), "yaw_deg": 90.0, "height": 0.003}
    board = Board("chessboard", columns=8, rows=5, square=0.03, **place)
    camera = camera_over(board, 60, 10, 0.7)
    save(tmp_path / "photo.png", photograph(board, camera))
    flags = ["--board.type=chessboard", "--board.columns=8", "--board.rows=5", "--board.square=0.03"]
    flags += ["--board.origin=[0.35, -0.1]", "--board.yaw_deg=90", "--board.height=0.003", "--camera=left"]
    flags += ["--workspace.center=[0.3, 0.02]", "--workspace.size=0.3"]
    code, error, _ = run("--images=photo.png", INTRINSICS, *flags)
    assert (code, error) == (0, "")
    calibration = read_calibration("cameras.yaml")
    assert pose_errors(camera, calibration.camera("left").world_from_cam)[1] < 1
    assert calibration.workspace == Workspace((0.3, 0.02), 0.3)


def test_other_cameras_of_the_file_are_kept(run, photo, tmp_path):
    other = Camera(K, camera_over(Board(), 70, -40).world_from_cam, 480, 640)
    workspace = Workspace((0.1, 0.1), 0.3)
    (tmp_path / "cameras.yaml").write_text(
        yaml.safe_dump(plain_calibration(Calibration({"wrist": other}, workspace, {"wrist": 0.001})))
    )
    assert run(f"--images={photo}", INTRINSICS)[0] == 0
    calibration = read_calibration("cameras.yaml")
    assert list(calibration.cameras) == ["wrist", "front"]
    np.testing.assert_allclose(calibration.camera("wrist").world_from_cam, other.world_from_cam, atol=1e-6)
    assert calibration.workspace == workspace
    assert calibration.depth_units == {"wrist": 0.001}


def test_a_file_in_the_axes_of_a_base_is_refused_and_kept(run, photo, tmp_path):
    other = plain_calibration(Calibration({"wrist": camera_over(Board(), 70, -40)}))
    text = yaml.safe_dump(other | {"robot_base": {"position": [0.1, 0.0, 0.02]}})
    (tmp_path / "cameras.yaml").write_text(text)
    code, error, _ = run(f"--images={photo}", INTRINSICS)
    assert code == 2
    assert "--output: cameras.yaml has robot_base or table_height" in error
    assert (tmp_path / "cameras.yaml").read_text() == text


def test_several_photographs_give_intrinsics_and_distortion(run, photos):
    code, error, log = run(f"--images={photos}")
    assert (code, error) == (0, "")
    entry = yaml.safe_load(Path("cameras.yaml").read_text())["cameras"]["front"]
    np.testing.assert_allclose(entry["intrinsics"], [615.3, 615.1, 319.5, 239.5], atol=0.7)
    np.testing.assert_allclose(entry["distortion"], DISTORTION, atol=0.02)
    lens = read_calibration(Path("cameras.yaml")).camera("front").lens
    assert lens is not None
    np.testing.assert_allclose(lens.coefficients, entry["distortion"], rtol=1e-6)
    assert pose_errors(CAMERA, np.array(entry["world_from_cam"]))[1] < 1
    assert log.count("reprojection error") == 14  # thirteen views and the pose
    assert "intrinsics from 13 images" in log


def test_a_photograph_without_the_board_is_skipped_for_intrinsics(run, photos, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for file in photos.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    save(folder / "99.png", np.full((480, 640, 3), 120, np.uint8))
    code, _, log = run("--images=photos", "--pose_image=00.png")
    assert code == 0
    assert "99.png is not used: no charuco board" in log


def test_intrinsics_are_read_from_a_file(run, photo, tmp_path):
    known = Calibration({"anything": CAMERA})
    (tmp_path / "k.yaml").write_text(yaml.safe_dump(plain_calibration(known)))
    assert run(f"--images={photo}", "--intrinsics=k.yaml")[0] == 0
    small = Camera(K / [[2], [2], [1]], CAMERA.world_from_cam, 240, 320)
    (tmp_path / "k.yaml").write_text(yaml.safe_dump(plain_calibration(Calibration({"anything": small}))))
    code, error, _ = run(f"--images={photo}", "--intrinsics=k.yaml")
    assert code == 2
    assert "k.yaml is of images of 320 x 240 pixels, these have 640 x 480" in error


def camera_info():
    """K as ROS's camera_calibration writes it."""
    content = yaml.safe_load(files.camera_info()) | {"image_width": 640, "image_height": 480}
    content["camera_matrix"] = files.matrix(K)
    content["distortion_coefficients"] = files.matrix(np.zeros((1, 5)))
    return yaml.safe_dump(content)


@pytest.mark.parametrize("content", [camera_info(), files.savetxt(K)], ids=["camera_info", "without an image size"])
def test_intrinsics_are_read_from_a_file_without_a_pose(run, photo, tmp_path, content):
    (tmp_path / "k").write_text(content)
    code, error, _ = run(f"--images={photo}", "--intrinsics=k")
    assert (code, error) == (0, "")
    assert pose_errors(CAMERA, read_calibration("cameras.yaml").camera("front").world_from_cam)[1] < 1


def test_intrinsics_from_a_file_of_a_pose_alone_are_refused(run, photo, tmp_path):
    (tmp_path / "pose.txt").write_text(files.savetxt(files.BASE_FROM_CAMERA))
    code, error, _ = run(f"--images={photo}", "--intrinsics=pose.txt")
    assert code == 2
    assert "--intrinsics: pose.txt has the pose of camera 'front', but no intrinsics" in error


@pytest.mark.parametrize(
    ("flags", "match"),
    [
        ([], "give images of the board: --images"),
        (["--images=nothing.png"], "--images: no image is at nothing.png"),
        (["--images=photo.png"], "--intrinsics, --images: the intrinsics need at least 5 images"),
        (["--images=photo.png", INTRINSICS, "--board.dictionary=5X5_50"], "markers of dictionary 4X4_50"),
        (["--images=photo.png", INTRINSICS, "--board.columns=5"], "photo.png, --board: "),
        (["--images=photo.png", "--intrinsics=1,2"], "--intrinsics: cannot read 1,2"),
        (["--images=photo.png", INTRINSICS, "--pose_image=no.png"], "none of the images: photo.png"),
        (["--images=photo.png", INTRINSICS, "--workspace.center=[3, 0]"], "sees 0% of the workspace"),
        (["--board.print=board.jpg"], r"--board.print: expected a file that ends in .pdf or .png"),
        (["--board.type=chessboard", "--board.print=board.pdf"], "looks the same after half a turn"),
        (["--refine=table"], "--refine=table needs a depth image"),
        (["--refine=floor"], "--refine must be table"),
        (["--images=photo.png", "--frames=0"], "--frames must be at least 1"),
        (["--dataset.repo_id=me/none", "--dataset.root=none"], "--dataset"),
        (["--device.type=unknown"], "unknown"),
    ],
)
def test_errors_name_the_flag_and_write_nothing(run, photo, tmp_path, flags, match):
    code, error, _ = run(*flags)
    assert code in (1, 2)
    assert error.startswith("symview-calibrate: error: ")
    assert match.replace("\\", "") in error
    assert len(error.splitlines()) == 1
    assert [file.name for file in tmp_path.iterdir()] == ["photo.png"]


def test_a_damaged_output_is_kept(run, photo, tmp_path):
    (tmp_path / "cameras.yaml").write_text("cameras: none")
    code, error, _ = run(f"--images={photo}", INTRINSICS)
    assert code == 2
    assert "--output: cameras.yaml: " in error
    assert (tmp_path / "cameras.yaml").read_text() == "cameras: none"


def test_images_of_two_sizes_are_refused(run, photo, tmp_path):
    save(tmp_path / "small.png", np.zeros((240, 320, 3), np.uint8))
    code, error, _ = run("--images=./*.png", INTRINSICS)
    assert code == 2
    assert "of one camera and size, got 320 x 240, 640 x 480" in error


@pytest.mark.parametrize("suffix", ["pdf", "png"])
def test_the_board_is_printed(run, tmp_path, suffix):
    code, _, log = run(f"--board.print=board.{suffix}")
    assert code == 0
    assert "a page of 297 x 210 mm: print it at 100 %" in log
    assert (tmp_path / f"board.{suffix}").stat().st_size < 300_000


def board_from(distance):
    return photograph(Board(), camera_over(Board(), 50, 30, distance))


def test_a_camera_of_lerobot_takes_the_image(run, monkeypatch):
    monkeypatch.setattr(FakeCamera, "see", board_from, raising=False)
    code, error, _ = run("--device.type=fake", "--device.position=0.6", INTRINSICS)
    assert (code, error) == (0, "")
    expected = camera_over(Board(), 50, 30, 0.6)
    assert pose_errors(expected, read_calibration("cameras.yaml").camera("front").world_from_cam)[1] < 1


def test_a_camera_that_fails_is_an_error_in_one_line(run, monkeypatch, tmp_path):
    def fail(_):
        raise RuntimeError("no frame arrived")

    monkeypatch.setattr(FakeCamera, "see", fail, raising=False)
    code, error, _ = run("--device.type=fake", INTRINSICS)
    assert (code, error) == (1, "symview-calibrate: error: --device: no frame arrived\n")
    assert not list(tmp_path.iterdir())


def tilted(camera, degrees, lift):
    """The camera with a pose that is wrong in tilt and height."""
    rotation, _ = cv2.Rodrigues(np.deg2rad([degrees, -0.5 * degrees, 0.0]))
    error = np.eye(4)
    error[:3, :3], error[2, 3] = rotation, lift
    return replace(camera, world_from_cam=error @ camera.world_from_cam)


@pytest.mark.parametrize("suffix", ["png", "npy"])
def test_depth_puts_the_table_at_zero(run, tmp_path, suffix):
    depth = plane_depth(CAMERA)
    depth[200:260, 300:360] -= 0.05  # an object
    depth += 0.002 * np.random.default_rng(0).normal(size=depth.shape)
    if suffix == "png":
        cv2.imwrite("depth.png", (1000 * depth).round().astype(np.uint16))
    else:
        np.save("depth.npy", depth.astype(np.float32))
    workspace = Workspace((0.12, 0.08))
    wrong = tilted(CAMERA, 2.0, 0.015)
    (tmp_path / "cameras.yaml").write_text(
        yaml.safe_dump(plain_calibration(Calibration({"front": wrong}, workspace, {"front": 0.001})))
    )
    code, error, log = run("--calibration=cameras.yaml", "--refine=table", f"--depth=depth.{suffix}")
    assert (code, error) == (0, "")
    assert "tilted by 2.2°, before the correction" in log
    refined = read_calibration("cameras.yaml")
    assert refined.depth_units == {"front": 0.001}
    rotation = CAMERA.cam_from_world[:3, :3] @ refined.camera("front").world_from_cam[:3, :3]
    up = refined.camera("front").world_from_cam[:3, :3] @ CAMERA.cam_from_world[:3, :3] @ [0, 0, 1]
    assert np.rad2deg(np.arccos(up[2])) < 0.1
    assert np.rad2deg(np.linalg.norm(cv2.Rodrigues(rotation)[0])) < 0.2
    assert abs(refined.camera("front").position[2] - CAMERA.position[2]) < 0.002


def test_a_photograph_through_a_fisheye_gives_the_pose(run, tmp_path):
    lens = Lens(EQUIDISTANT, (0.05, -0.01, 0.002, 0.0))
    camera = replace(camera_over(Board(), 55, 20, 0.6), lens=lens)
    ideal = to_ideal(np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1), camera)
    wide_k = K + [[0, 0, 320], [0, 0, 240], [0, 0, 0]]
    wide = photograph(Board(), Camera(wide_k, camera.world_from_cam, 960, 1280), noise=0.0)
    u, v = np.moveaxis(ideal + [320, 240], -1, 0).astype(np.float32)
    save(tmp_path / "photo.png", cv2.remap(wide, u, v, cv2.INTER_LINEAR))
    known = plain_calibration(Calibration({"front": replace(camera, world_from_cam=CAMERA.world_from_cam)}))
    (tmp_path / "lens.yaml").write_text(yaml.safe_dump(known))
    code, error, _ = run("--images=photo.png", "--intrinsics=lens.yaml", "--camera=front")
    assert code == 0, error
    found = read_calibration("cameras.yaml").camera("front")
    degrees, millimetres = pose_errors(camera, found.world_from_cam)
    assert degrees < 0.1
    assert millimetres < 1
    assert found.lens.model == EQUIDISTANT
    np.testing.assert_allclose(found.lens.coefficients, lens.coefficients, atol=1e-6)


def test_a_calibration_that_is_far_off_is_not_refined(run, tmp_path):
    np.save("depth.npy", plane_depth(CAMERA))
    wrong = Calibration({"front": tilted(CAMERA, 0, 0.2)}, Workspace((0.12, 0.08)))
    (tmp_path / "cameras.yaml").write_text(yaml.safe_dump(plain_calibration(wrong)))
    before = (tmp_path / "cameras.yaml").read_text()
    code, error, _ = run("--calibration=cameras.yaml", "--refine=table", "--depth=depth.npy")
    assert code == 2
    assert "--refine=table: " in error
    assert (tmp_path / "cameras.yaml").read_text() == before


def test_a_dataset_gives_depth_and_the_picture(run, recorded, tmp_path):
    source = SourceDataset(recorded)
    table = EpisodeTables(source, source.data_file(0)).read(0)
    k, pose = (vectors(table, key("side"))[0] for key in (keys.intrinsics, keys.world_from_cam))
    height, width, _ = source.features[keys.rgb("side")]["shape"]
    true = stored_camera(k, pose, height, width)
    (tmp_path / "cameras.yaml").write_text(
        yaml.safe_dump(plain_calibration(Calibration({"side": tilted(true, 1.5, 0.01)}, Workspace())))
    )
    flags = ["--dataset.repo_id=test/recorded", f"--dataset.root={recorded}", "--camera=side"]
    code, error, _ = run("--calibration=cameras.yaml", "--refine=table", *flags)
    assert (code, error) == (0, "")
    assert pose_errors(true, read_calibration("cameras.yaml").camera("side").world_from_cam)[0] < 0.3
    assert (tmp_path / "cameras_side.png").exists()
    code, error, _ = run(*flags, INTRINSICS, "--frames=3", "--episodes=[0, 1]")
    assert code == 2
    assert "episode 0, frame 0, --board: no charuco board" in error
    code, error, _ = run(*flags, "--episodes=[7]")
    assert "there is no episode 7" in error


def test_files_of_other_tools_are_converted_and_written_back(run, tmp_path):
    without_lens = files.camera_info(distortion_coefficients=files.matrix([[0.0] * 5]), distortion_model="plumb_bob")
    (tmp_path / "k.yaml").write_text(without_lens)
    (tmp_path / "pose.calib").write_text(files.handeye2())
    code, error, _ = run("--convert=[k.yaml, pose.calib]", "--camera=front")
    assert code == 0, error
    camera = read_calibration(tmp_path / "cameras.yaml").camera("front")
    np.testing.assert_allclose(camera.world_from_cam, files.BASE_FROM_CAMERA, atol=1e-6)
    for to, name in (("camera_info", "back.yaml"), ("easy_handeye2", "back.calib")):
        assert run("--convert=[cameras.yaml]", "--camera=front", f"--to={to}", f"--output={name}")[0] == 0
    again = read_calibration([tmp_path / "back.yaml", tmp_path / "back.calib"], "front").camera("front")
    np.testing.assert_allclose(again.world_from_cam, camera.world_from_cam, atol=1e-6)
    np.testing.assert_allclose(again.intrinsics, camera.intrinsics, atol=1e-3)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--convert=[k.yaml]"], "no pose of the camera in the robot's base or the world: add a file"),
        (["--convert=[k.yaml]", "--to=kalibr"], "--to 'kalibr'"),
        (["--to=camera_info"], "--to is the format that --convert writes"),
        (["--convert=[missing.yaml]"], "missing.yaml"),
    ],
)
def test_what_cannot_be_converted_is_an_error_in_one_line(run, tmp_path, flags, message):
    (tmp_path / "k.yaml").write_text(files.camera_info())
    code, error, _ = run(*flags)
    assert code
    assert message in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "cameras.yaml").exists()
