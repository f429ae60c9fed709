import json

import numpy as np
import pytest
import yaml

from lerobot_symview.calibration.file import parse_calibration, plain_calibration
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import project
from lerobot_symview.geometry.visibility import check_camera
from lerobot_symview.geometry.workspace import Workspace
from tests.helpers.cameras import make_camera


def content(**changes):
    camera = make_camera(size=64)
    front = {
        "height": 64,
        "width": 64,
        "intrinsics": camera.intrinsics.tolist(),
        "world_from_cam": camera.world_from_cam.tolist(),
    }
    return {"units": "m", "cameras": {"front": front | changes}}


@pytest.mark.parametrize("write", [yaml.safe_dump, json.dumps])
def test_calibration_files_are_yaml_or_json(tmp_path, write):
    file = tmp_path / "cameras"
    file.write_text(write(content() | {"workspace": {"center": [0.5, 0.1], "size": 0.3}}))
    calibration = read_calibration(file)
    np.testing.assert_allclose(calibration.camera("front").world_from_cam, make_camera().world_from_cam)
    assert calibration.workspace == Workspace((0.5, 0.1), 0.3)
    assert parse_calibration(plain_calibration(calibration)).workspace == calibration.workspace


def test_translations_in_millimetres_are_converted_to_metres():
    pose = make_camera(size=64).world_from_cam.copy()
    pose[:3, 3] *= 1000
    calibration = parse_calibration(content(world_from_cam=pose.tolist()) | {"units": "mm"})
    np.testing.assert_allclose(calibration.camera("front").position, make_camera().position)


@pytest.mark.parametrize(("units", "scale"), [("m", 1.0), ("mm", 1000.0)])
def test_with_the_robots_base_everything_is_in_its_axes(units, scale):
    """A point in the frame of the base projects to the same pixel; z still counts from the table."""
    base = {"position": [scale * value for value in (0.2, -0.3, 0.05)], "yaw_deg": 90}
    pose = make_camera(size=64).world_from_cam.copy()
    pose[:3, 3] *= scale
    given = content(world_from_cam=pose.tolist()) | {"units": units, "workspace": {"center": [0.45, 0.1]}}
    plain, calibration = (parse_calibration(one) for one in (given, given | {"robot_base": base}))
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3)) + [0.45, 0.0, 0.1]
    offset = points - [0.2, -0.3, 0.0]
    in_base = np.column_stack([offset[:, 1], -offset[:, 0], offset[:, 2]])
    pixels, _ = project(points, plain.camera("front"))
    np.testing.assert_allclose(project(in_base, calibration.camera("front"))[0], pixels, atol=1e-4)
    assert calibration.workspace.center == pytest.approx((0.4, -0.25))
    assert calibration.origin_height == pytest.approx(0.05)
    again = parse_calibration(plain_calibration(calibration))
    assert again.origin_height == calibration.origin_height
    assert again.workspace == calibration.workspace
    np.testing.assert_array_equal(again.camera("front").world_from_cam, calibration.camera("front").world_from_cam)


@pytest.mark.parametrize("base", [None, {"position": [0.0, 0.0, 0.9]}])
def test_a_table_at_another_height_is_at_z_0(base):
    raised = make_camera(size=64).world_from_cam.copy()
    raised[2, 3] += 0.8
    given = content(world_from_cam=raised.tolist()) | {"workspace": {"center": [0.45, 0.1], "table_height": 0.8}}
    calibration = parse_calibration(given | ({"robot_base": base} if base else {}))
    np.testing.assert_allclose(calibration.camera("front").world_from_cam, make_camera().world_from_cam, atol=1e-6)
    assert calibration.workspace == Workspace((0.45, 0.1))
    assert calibration.origin_height == pytest.approx(0.1 if base else -0.8)
    again = parse_calibration(plain_calibration(calibration))
    assert (again.origin_height, again.is_in_base_axes) == (calibration.origin_height, base is not None)
    with pytest.raises(CalibrationError, match=r"origin must be within 3 m of the table, got -4.8 m"):
        parse_calibration(given | {"origin_height": -4.0})
    with pytest.raises(CalibrationError, match="workspace: table_height must be a number of metres"):
        parse_calibration(content() | {"workspace": {"table_height": "low"}})


@pytest.mark.parametrize(
    ("base", "message"),
    [
        ([0, 0, 0], "robot_base: expected a mapping with position and yaw_deg"),
        ({"place": [0, 0, 0]}, "robot_base: expected a mapping with position and yaw_deg"),
        ({"position": [0, 0]}, "robot_base: position must be three numbers"),
        ({"yaw_deg": "left"}, "robot_base: yaw_deg must be a number"),
        ({"position": [0, 0, np.nan]}, "robot_base: position and yaw_deg must be finite"),
    ],
)
def test_an_invalid_base_is_an_error(base, message):
    with pytest.raises(CalibrationError, match=message):
        parse_calibration(content() | {"robot_base": base})


@pytest.mark.parametrize(("units", "scale"), [("m", 1.0), ("mm", 1000.0)])
def test_matrices_are_rounded_to_the_float32_of_datasets(units, scale):
    pose = make_camera(17.0, 23.0, size=64).world_from_cam.copy()
    pose[:3, 3] *= scale
    parsed = parse_calibration(content(world_from_cam=pose.tolist()) | {"units": units})
    camera = parsed.camera("front")
    for matrix in (camera.intrinsics, camera.world_from_cam):
        np.testing.assert_array_equal(matrix, matrix.astype(np.float32))
    again = parse_calibration(json.loads(json.dumps(plain_calibration(parsed)))).camera("front")
    np.testing.assert_array_equal(again.world_from_cam, camera.world_from_cam)
    np.testing.assert_array_equal(again.intrinsics, camera.intrinsics)


def test_the_example_in_the_documentation_is_valid():
    import lerobot_symview.calibration.file as module

    example = module.__doc__.split("JSON:\n")[1]
    camera = parse_calibration(yaml.safe_load(example)).camera("front")
    check_camera("front", camera, Workspace())


REFLECTED = np.diag([1.0, -1.0, 1.0, 1.0]).tolist()
STRETCHED = np.diag([1.1, 1.0, 1.0, 1.0]).tolist()


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        ([], "expected a mapping"),
        ({"cameras": content()["cameras"]}, "units must be m or mm, got None"),
        (content() | {"units": "inch"}, "units must be m or mm, got 'inch'"),
        ({"units": "m"}, "at least one camera"),
        (content() | {"cameras": {"front": {}}}, "lacks height, width, intrinsics; expected one of world_from_cam, "),
        (content(fov=3), "unknown keys: fov"),
        (content() | {"camera": 1}, "unknown keys: camera;"),
        (content(height=-3), "height must be a positive number of pixels, got -3"),
        (content(intrinsics=[[1, 0], [0, 1], [1, 1]]), "intrinsics must be fx, fy, cx, cy or 3 rows of 3 numbers"),
        (content(intrinsics=[[-60, 0, 31], [0, 60, 31], [0, 0, 1]]), "focal lengths must be positive"),
        (content(intrinsics=[[60, 0, 310], [0, 60, 31], [0, 0, 1]]), r"principal point .* lies outside"),
        (content(world_from_cam=REFLECTED), "left-handed"),
        (content(world_from_cam=STRETCHED), "not orthonormal"),
        (content(intrinsics=[[1e300, 0, 31], [0, 60, 31], [0, 0, 1]]), "must be finite"),
        (content(world_from_cam="somewhere"), r"world_from_cam must be 4 \(or the first 3\) rows of 4 numbers"),
        (content() | {"workspace": {"size": -1}}, "workspace: .*positive"),
        (
            content() | {"workspace": {"side": 1}},
            "workspace: expected a mapping with any of center, size, height_limit",
        ),
    ],
)
def test_invalid_content_raises_an_error_that_names_the_problem(broken, message):
    with pytest.raises(CalibrationError, match=message):
        parse_calibration(broken)


def test_one_error_lists_all_problems():
    broken = content(height=0) | {"units": "yard", "workspace": 3}
    with pytest.raises(CalibrationError, match=r"units.*camera 'front'.*workspace"):
        parse_calibration(broken)


@pytest.mark.parametrize("text", ["units: [", "\x00"])
def test_an_unreadable_file_is_named_in_the_error(tmp_path, text):
    file = tmp_path / "cameras.yaml"
    file.write_text(text)
    with pytest.raises(CalibrationError, match=r"cannot read .*cameras\.yaml"):
        read_calibration(file)
    with pytest.raises(CalibrationError, match="cannot read"):
        read_calibration(tmp_path / "nowhere.yaml")


def test_an_unknown_camera_error_lists_the_known_cameras():
    with pytest.raises(CalibrationError, match="no camera 'side'; it has front"):
        parse_calibration(content()).camera("side")
