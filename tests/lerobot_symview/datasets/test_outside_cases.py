"""Recordings and calibration files as outsiders have them: the right value where it can be told, else an error."""

import dataclasses
import json

import numpy as np
import pytest
import torch
import yaml

from lerobot_policy_symview.processor_views import ViewsProcessorStep
from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_calibration, plain_calibration
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.datasets.add_views import add_views
from lerobot_symview.datasets.image_codec import decode_depth
from lerobot_symview.errors import CalibrationError, DatasetError
from lerobot_symview.geometry.camera import invert_rigid
from lerobot_symview.runtime.cli import DatasetLocation
from lerobot_symview.views import make_view
from symview_eval.preview import PreviewConfig, preview
from tests.helpers.cameras import make_camera, plane_depth
from tests.helpers.datasets import images_of, in_mm, record_real_robot, views_config

CAMERA = make_camera(45, 30, size=96)
VIEWS = {"reproj": make_view("reproj", clip="none"), "persp": make_view("persp", gripper=False)}
DEPTHS = {
    "mm": in_mm(plane_depth(CAMERA)),
    "tenth": in_mm(plane_depth(CAMERA), 0.0001),
    "quarter": in_mm(plane_depth(CAMERA), 0.00025),
    "float mm": (1000 * plane_depth(CAMERA)).astype(np.float32),
    "m": plane_depth(CAMERA).astype(np.float32),
}
UNITS = {"mm": 0.001, "tenth": 0.0001, "quarter": 0.00025, "float mm": 0.001, "m": 1.0}
RGB = np.full((96, 96, 3), (200, 100, 50), np.uint8)


def calibration(**changes):
    front = {"height": 96, "width": 96, "intrinsics": CAMERA.intrinsics.tolist()}
    if not {"world_from_cam", "cam_from_world", "position"} & set(changes):
        front["world_from_cam"] = CAMERA.world_from_cam.tolist()
    return {"units": "m", "workspace": {"center": [0.45, 0.0], "size": 0.3}, "cameras": {"front": front | changes}}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    for name, depth in DEPTHS.items():
        record_real_robot(folder / name, RGB, depth)
    return folder


def with_views(source, tmp_path, content, **options):
    file = tmp_path / "cameras.yaml"
    file.write_text(yaml.safe_dump(content))
    views = VIEWS | {"camera": "front", "calibration": file, "size": 32} | options
    return add_views(views_config(source, tmp_path / "views", **views))


def undeclared(source, target):
    """Copy of a recording whose depth declares no unit."""
    import shutil

    shutil.copytree(source, target)
    file = target / "meta" / "info.json"
    info = json.loads(file.read_text())
    info["features"][keys.depth("front")]["info"].pop("depth_unit", None)
    file.write_text(json.dumps(info))
    return target


@pytest.mark.parametrize("name", DEPTHS)
def test_the_table_tells_an_undeclared_depth_unit(recordings, tmp_path, name, caplog):
    caplog.set_level("INFO")
    source = undeclared(recordings / name, tmp_path / "source")
    made = with_views(source, tmp_path, calibration())
    np.testing.assert_allclose(images_of(made, keys.view("front", "reproj_height")), 0.0, atol=0.001)
    assert "the table at z = 0 shows" in caplog.text


@pytest.mark.parametrize("name", DEPTHS)
@pytest.mark.parametrize("by", ["flag", "file"])
def test_a_given_depth_unit_decides(recordings, tmp_path, name, by):
    unit = {"flag": {"depth_unit": str(UNITS[name])}, "file": {}}[by]
    content = calibration() if by == "flag" else calibration(depth_unit=UNITS[name])
    made = with_views(recordings / name, tmp_path, content, **unit)
    np.testing.assert_allclose(images_of(made, keys.view("front", "reproj_height")), 0.0, atol=0.001)


@pytest.mark.parametrize("name", ["tenth", "quarter", "m"])
def test_a_wrong_depth_unit_is_an_error_and_writes_nothing(recordings, tmp_path, name):
    right = {"tenth": "units of 0.0001 m", "quarter": "units of 0.00025 m", "m": "metres"}[name]
    with pytest.raises(CalibrationError, match=f"--depth_unit: .*if depth were in {right}, not in millimetres"):
        with_views(recordings / name, tmp_path, calibration(), depth_unit="mm")
    assert not list(tmp_path.glob("views*"))


TURNED = np.diag([1.0, -1.0, -1.0, 1.0]) @ CAMERA.world_from_cam
FAR, INVERSE = CAMERA.world_from_cam.copy(), invert_rigid(CAMERA.world_from_cam)
FAR[:3, 3] *= 1000
HIGH = CAMERA.world_from_cam.copy()
HIGH[2, 3] += 0.06
WRONG = {
    "below the table": (TURNED, "is below the table, at z = -0.57"),
    "millimetres": (FAR, "with a position in millimetres"),
    "inverse": (INVERSE, "with the direction cam_from_world"),
    "6 cm too high": (HIGH, r"the table lies at z = \+6"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_pose_is_an_error_in_add_views_preview_and_a_policys_step(recordings, tmp_path, kind):
    pose, message = WRONG[kind]
    content = calibration(world_from_cam=pose.tolist())
    with pytest.raises(CalibrationError, match=message):
        with_views(recordings / "mm", tmp_path, content)
    assert not list(tmp_path.glob("views*"))
    location = DatasetLocation("test/real", recordings / "mm")
    config = PreviewConfig(
        location, camera="front", calibration=tmp_path / "cameras.yaml", rerun=False, output_dir=tmp_path, **VIEWS
    )
    with pytest.raises(CalibrationError, match=message):
        preview(config)
    with pytest.raises(CalibrationError, match=message):
        ViewsProcessorStep([{"name": "reproj", "clip": "none"}], "front", calibration=content).observation(observed())


def observed(depth=DEPTHS["mm"]):
    return {
        keys.rgb("front"): torch.from_numpy(RGB).permute(2, 0, 1)[None],
        keys.depth("front"): torch.from_numpy(depth)[None, None],
        keys.STATE: torch.zeros(1, 6),
    }


@pytest.mark.parametrize("name", DEPTHS)
@pytest.mark.parametrize("stated", [False, True])
def test_a_robots_depth_of_any_unit_makes_the_right_view(name, stated):
    content = calibration(depth_unit=UNITS[name]) if stated else calibration()
    step = ViewsProcessorStep([{"name": "reproj", "clip": "none"}], "front", calibration=content, gripper=[])
    made = step.observation(observed(DEPTHS[name]))
    np.testing.assert_allclose(made[keys.view("front", "reproj_height")].numpy(), 0.0, atol=0.001)


def test_an_observation_without_depth_is_an_error_and_not_a_black_view():
    step = ViewsProcessorStep([{"name": "reproj", "clip": "none"}], "front", calibration=calibration(), gripper=[])
    with pytest.raises(CalibrationError, match=r"front_depth has no valid pixel in the workspace"):
        step.observation(observed(np.zeros_like(DEPTHS["mm"])))


def test_a_recording_without_depth_is_an_error(tmp_path):
    record_real_robot(tmp_path / "source", RGB, np.zeros_like(DEPTHS["mm"]))
    with pytest.raises(DatasetError, match=r"front_depth has no valid pixel in the workspace"):
        with_views(tmp_path / "source", tmp_path, calibration())


def test_a_table_that_the_robot_hides_is_a_warning(tmp_path, caplog):
    depth = plane_depth(CAMERA)
    depth[20:] = 0.3
    record_real_robot(tmp_path / "source", RGB, in_mm(depth))
    with_views(tmp_path / "source", tmp_path, calibration())
    assert "front_depth does not show the table: its unit and the camera's pose are not checked" in caplog.text


def test_eight_bits_are_no_depth():
    import cv2

    png = bytes(cv2.imencode(".png", np.full((4, 4), 200, np.uint8))[1])
    with pytest.raises(ValueError, match=r"one channel of 16 or 32 bits, got shape .* of uint8"):
        decode_depth(png)


def test_intrinsics_of_another_image_size_are_a_warning(tmp_path, caplog):
    k = CAMERA.intrinsics.copy()
    k[:2] /= 2
    file = tmp_path / "cameras.yaml"
    file.write_text(yaml.safe_dump(calibration(intrinsics=k.tolist())))
    read_calibration(file)
    assert "are the intrinsics those of another image size?" in caplog.text
    caplog.clear()
    file.write_text(yaml.safe_dump(calibration()))
    read_calibration(file)
    assert not caplog.messages


def test_depth_of_another_size_names_both_keys_and_the_remedy(tmp_path):
    record_real_robot(tmp_path / "source", RGB, DEPTHS["mm"][::2, ::2])
    message = r"front_depth has 48 x 48 pixels, observation\.images\.front has 96 x 96: .*align depth to colour"
    with pytest.raises(DatasetError, match=message):
        with_views(tmp_path / "source", tmp_path, calibration())
    step = ViewsProcessorStep([{"name": "reproj", "clip": "none"}], "front", calibration=calibration(), gripper=[])
    with pytest.raises(DatasetError, match=message):
        step.observation(observed(DEPTHS["mm"][::2, ::2]))


def test_a_pose_of_three_decimals_is_taken_as_the_nearest_rotation(caplog):
    caplog.set_level("INFO")
    rounded = parse_calibration(calibration(world_from_cam=CAMERA.world_from_cam.round(3).tolist())).camera("front")
    np.testing.assert_allclose(rounded.world_from_cam, CAMERA.world_from_cam, atol=6e-4)
    np.testing.assert_allclose(rounded.world_from_cam[:3, :3].T @ rounded.world_from_cam[:3, :3], np.eye(3), atol=1e-6)
    assert "is not orthonormal" in caplog.text


def test_other_forms_of_the_same_camera_are_equal():
    from scipy.spatial.transform import Rotation

    k, pose = CAMERA.intrinsics, CAMERA.world_from_cam
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    forms = [
        calibration(world_from_cam=pose[:3].tolist()),
        calibration(cam_from_world=invert_rigid(pose).tolist()),
        calibration(position=pose[:3, 3].tolist(), quaternion_xyzw=quaternion),
        calibration(intrinsics=[k[0, 0], k[1, 1], k[0, 2], k[1, 2]]),
        calibration(intrinsics={"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}),
        calibration(distortion=[0.0, 0, 0, 0, 0]),
    ]
    for form in forms:
        camera = parse_calibration(form).camera("front")
        np.testing.assert_allclose(camera.world_from_cam, pose, atol=1e-6)
        np.testing.assert_allclose(camera.intrinsics, k, atol=1e-4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"distortion": [0.1, 0, 0]}, "plumb_bob has 4 or 5 coefficients, got 3"),
        ({"distortion": [0.1] * 4, "distortion_model": "thin_prism"}, "lens model 'thin_prism' is not supported"),
        ({"distortion": ["k1"]}, "distortion must be OpenCV's 4, 5 or 8 coefficients"),
        ({"distortion": [-1.0, 0, 0, 0, 0]}, "lens shows rays only up to .* pixels from the principal point"),
        ({"position": [0, 0, 1]}, "position and quaternion_xyzw belong together"),
        ({"position": [0, 0, 1], "quaternion_xyzw": [1, 1, 0, 0]}, "must have length 1, got 1.41"),
        (
            {"world_from_cam": [], "cam_from_world": []},
            "expected one of world_from_cam",
        ),
        (
            {"depth_unit": "inch"},
            "must be m, mm or a positive number of metres such as 0.0001, got 'inch'",
        ),
        ({"depth_unit": -1}, "a depth unit must be"),
    ],
)
def test_malformed_cameras_are_named(changes, message):
    with pytest.raises(CalibrationError, match=message):
        parse_calibration(calibration(**changes))


def test_the_depth_unit_of_a_calibration_is_kept():
    parsed = parse_calibration(calibration(depth_unit="mm"))
    assert parse_calibration(plain_calibration(parsed)).depth_units == parsed.depth_units == {"front": 0.001}
    assert dataclasses.replace(parsed, depth_units={}) != parsed
