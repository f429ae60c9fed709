"""Files that complete each other, poses whose reading is not said, and the way back to other tools."""

import json
import logging

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from lerobot_symview.calibration.convert import convert
from lerobot_symview.calibration.file import parse_calibration, plain_calibration
from lerobot_symview.calibration.read import read_calibration, read_intrinsics
from lerobot_symview.calibration.readings import PoseReading, ReadingError, readings
from lerobot_symview.calibration.writers import camera_info, easy_handeye2
from lerobot_symview.errors import CalibrationError, OptionError
from lerobot_symview.geometry.camera import orbit_pose
from lerobot_symview.geometry.workspace import Workspace
from tests.lerobot_symview.calibration.formats import files

SIZE = (files.HEIGHT, files.WIDTH)


@pytest.fixture
def write(tmp_path):
    def write(name, content):
        path = tmp_path / name
        path.write_text(content)
        return path

    return write


@pytest.fixture
def intrinsics(write):
    return write("k.json", files.realsense(coeffs=[0] * 5))


def ours(**entries):
    return yaml.safe_dump({"units": "m", "cameras": {"front": entries}})


def pose_of(sources, workspace=files.WORKSPACE, reading=None):
    return read_calibration(sources, "front", SIZE, workspace, reading).camera("front").world_from_cam


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("scale", [1, 1000])
@pytest.mark.parametrize("axes", [np.eye(3), np.diag([1, -1, -1]), np.array([[0, -1.0, 0], [0, 0, -1], [1, 0, 0]])])
def test_the_reading_that_sees_the_workspace_is_found_and_logged(write, intrinsics, caplog, inverse, scale, axes):
    """A matrix says neither direction nor axes nor unit."""
    pose = files.BASE_FROM_CAMERA.copy()
    pose[:3, :3] = pose[:3, :3] @ axes
    pose = np.linalg.inv(pose) if inverse else pose
    pose[:3, 3] *= scale
    file = write("pose.txt", files.savetxt(pose))
    with caplog.at_level(logging.INFO):
        found = pose_of([intrinsics, file])
    np.testing.assert_allclose(found, files.BASE_FROM_CAMERA, atol=1e-6)
    *unit, line = caplog.messages
    assert len(unit) == (scale != 1)
    assert all("is read as millimetres" in each for each in unit)
    assert f"read as {'base_to_camera' if inverse else 'camera_to_base'}, " in line
    assert "the only one of 6 readings that sees the workspace" in line


@pytest.mark.parametrize(
    "content",
    [
        files.realsense(coeffs=[0] * 5),
        files.camera_matrix(),
        ours(height=files.HEIGHT, width=files.WIDTH, intrinsics=files.K.tolist()),
        ours(height=files.HEIGHT, width=files.WIDTH, intrinsics=files.K.tolist())
        + "workspace: {size: 0.4, table_height: 0.8}",
        ours(height=files.HEIGHT, width=files.WIDTH, intrinsics=files.K.tolist(), position=[0, 0, "no number"]),
        files.camera_to_world(),
    ],
)
def test_intrinsics_are_read_without_the_pose(write, content):
    camera = read_intrinsics(write("k", content), "front", SIZE)
    np.testing.assert_allclose(camera.intrinsics, files.K, atol=1e-3)
    assert (camera.height, camera.width) == SIZE


@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
@pytest.mark.parametrize("azimuth", [-100, 75, 150])
def test_the_order_of_a_quaternion_is_found(write, intrinsics, order, azimuth):
    pose = orbit_pose(np.deg2rad(40), np.deg2rad(azimuth), 0.8, [0.45, 0.05, 0])
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=order == "wxyz").tolist()
    content = {"base_frame_id": "base", "pos": pose[:3, 3].tolist(), "quat": quaternion}
    np.testing.assert_allclose(pose_of([intrinsics, write("p.json", json.dumps(content))]), pose, atol=1e-6)


def test_a_pose_with_several_readings_lists_what_each_sees(write, intrinsics):
    """A camera straight above a workspace at the origin sees it with the inverse too."""
    pose = orbit_pose(np.pi / 2, 0.0, 0.8, [0.02, 0.01, 0])
    file, workspace = write("pose.txt", files.savetxt(pose)), Workspace((0, 0), 0.2)
    with pytest.raises(ReadingError, match="readings of its pose see the workspace") as caught:
        pose_of([intrinsics, file], workspace)
    message = str(caught.value)
    assert message.startswith(f"{file}: camera 'front': 2 readings")
    assert "camera_to_base, optical axes: sees 100% of it from (0.02, 0.01, 0.80)" in message
    assert "base_to_camera, optical axes: sees 100%" in message
    assert "opengl" not in message
    found = pose_of([intrinsics, file], workspace, PoseReading(direction="base_to_camera"))
    np.testing.assert_allclose(found, np.linalg.inv(pose), atol=1e-6)


def test_a_hopeless_pose_lists_readings_with_what_each_sees(write, intrinsics):
    pose = orbit_pose(np.deg2rad(45), 0.3, 0.9, [5.0, 5.0, 0])
    with pytest.raises(ReadingError, match="none of 6 readings of its pose sees the workspace") as caught:
        pose_of([intrinsics, write("pose.txt", files.savetxt(pose))])
    for reading in ("camera_to_base, optical axes: sees 0% of the workspace", "base_to_camera, ros_link axes: "):
        assert reading in str(caught.value)


def test_without_a_workspace_readings_are_not_guessed(write, intrinsics):
    with pytest.raises(ReadingError, match="does not say which pose it is: camera_to_base, optical axes; "):
        pose_of([intrinsics, write("pose.txt", files.savetxt(files.BASE_FROM_CAMERA))], None)


def test_what_a_format_says_is_not_guessed_and_the_user_may_overrule_it(write, intrinsics):
    """A file of easy_handeye2 with the inverse, as users often have it."""
    content = yaml.safe_load(files.handeye2())
    x, y, z, w = Rotation.from_matrix(files.CAMERA_FROM_BASE[:3, :3]).as_quat().tolist()
    content["transform"] = {
        "rotation": {"x": x, "y": y, "z": z, "w": w},
        "translation": dict(zip("xyz", files.CAMERA_FROM_BASE[:3, 3].tolist(), strict=True)),
    }
    file = write("inverse.calib", yaml.safe_dump(content))
    np.testing.assert_allclose(pose_of([intrinsics, file]), files.CAMERA_FROM_BASE, atol=1e-6)
    found = pose_of([intrinsics, file], reading=PoseReading(direction="base_to_camera"))
    np.testing.assert_allclose(found, files.BASE_FROM_CAMERA, atol=1e-6)


@pytest.mark.parametrize("entry", ["direction", "quaternion_order", "camera_axes", "unit"])
def test_an_unknown_reading_names_the_known_ones(entry):
    with pytest.raises(OptionError, match=f"the pose's {entry} must be one of .*, got 'up'"):
        PoseReading(**{entry: "up"})


def test_a_rounded_rotation_is_orthonormal_before_it_is_inverted(write, intrinsics):
    rounded = files.CAMERA_FROM_BASE.round(3)
    rounded[:3, 3] = files.CAMERA_FROM_BASE[:3, 3]
    found = pose_of([intrinsics, write("pose.txt", files.savetxt(rounded))])
    np.testing.assert_allclose(found, files.BASE_FROM_CAMERA, atol=1.5e-3)
    np.testing.assert_allclose(found[:3, :3].T @ found[:3, :3], np.eye(3), atol=1e-6)


def test_our_own_file_completes_others(write):
    """Its workspace decides between readings, and its millimetres are not those of another file."""
    own = yaml.safe_load(ours(intrinsics=[files.FX, files.FY, files.CX, files.CY], height=720, width=1280))
    own |= {"units": "mm", "workspace": {"center": [0.45, 0.05], "size": 0.4}}
    sources = [write("cameras.yaml", yaml.safe_dump(own)), write("t.txt", files.savetxt(files.CAMERA_FROM_BASE))]
    read = read_calibration(sources)
    np.testing.assert_allclose(read.camera("front").world_from_cam, files.BASE_FROM_CAMERA, atol=1e-6)
    assert read.workspace == files.WORKSPACE
    posed = ours(world_from_cam=files.BASE_FROM_CAMERA.tolist())
    sources = [write("own.yaml", posed), write("k.txt", files.savetxt(files.K))]
    np.testing.assert_allclose(pose_of(sources), files.BASE_FROM_CAMERA, atol=1e-6)


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        (files.realsense(fx=500), files.kalibr(), "both give the intrinsics"),
        (files.droid(), files.handeye2(), "both give the pose"),
        (files.handeye2(), files.handeye2(), "both give the pose"),
        (files.savetxt(files.K), files.camera_info(image_width=640), "both give the intrinsics"),
        (ours(height=480, width=640), files.realsense(), "both give the image size"),
    ],
)
def test_a_contradiction_names_both_files(write, first, second, message):
    sources = [write("first", first), write("second", second)]
    with pytest.raises(CalibrationError, match=f"first and .*second {message} of camera 'front'"):
        convert(sources, "front", SIZE, files.WORKSPACE)


def test_the_same_said_twice_is_no_contradiction(write):
    sources = [write("k.txt", files.savetxt(files.K)), write("bop", files.bop())]
    np.testing.assert_allclose(pose_of(sources), files.BASE_FROM_CAMERA, atol=1e-6)


@pytest.mark.parametrize(
    ("content", "size", "message"),
    [
        (files.camera_info(), None, "has the intrinsics, image size .* but no pose .*: add a file .*easy_handeye2"),
        (files.savetxt(files.K), None, "has the intrinsics .* no pose .*no height and width"),
        (files.handeye2(), SIZE, "has the pose of camera 'front', but no intrinsics: add a file with K, .*camera_info"),
        (files.bop(), None, "has the intrinsics, .* no height and width of the image"),
    ],
)
def test_a_part_that_is_missing_is_named(write, content, size, message):
    with pytest.raises(CalibrationError, match=f"file {message}"):
        convert([write("file", content)], "front", size, files.WORKSPACE)


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [("left", 0.1), ("1234_right", 0.2), ("wrist", None), (None, None), ("1234", None)],
)
def test_a_camera_is_chosen_by_its_name(write, intrinsics, wanted, expected):
    cameras = {"1234_left": {"pose": [0.1] * 6}, "1234_right": {"pose": [0.2] * 6}}
    sources = [write("droid.json", json.dumps(cameras)), intrinsics]
    if expected is None:
        with pytest.raises(CalibrationError, match="has the cameras 1234_left, 1234_right"):
            convert(sources, wanted)
    else:
        (camera,) = parse_calibration(convert(sources, wanted)).cameras.values()
        np.testing.assert_allclose(camera.position, expected, rtol=1e-6)


def test_a_camera_without_a_wanted_name_has_the_name_of_its_file(write, intrinsics):
    assert list(convert([write("d", files.droid()), intrinsics])["cameras"]) == ["12345678_left"]
    assert list(convert([write("h", files.handeye2()), intrinsics])["cameras"]) == ["camera"]


def test_cameras_are_written_for_ros_and_read_again(write):
    sources = [write("k", files.camera_info()), write("pose", files.handeye2())]
    content = convert(sources, "front")
    written = [write("k2", camera_info(content, "front")), write("pose2", easy_handeye2(content, "front"))]
    again = convert(written, "front")["cameras"]["front"]
    entries = content["cameras"]["front"]
    assert set(again) == set(entries)
    for key in ("height", "width", "distortion_model"):
        assert again[key] == entries[key]
    for key in ("intrinsics", "world_from_cam", "distortion"):
        np.testing.assert_allclose(again[key], entries[key], atol=1e-6)
    assert yaml.safe_load(written[0].read_text())["camera_name"] == "front"


def test_our_own_file_is_written_for_ros(write):
    plain = plain_calibration(parse_calibration(yaml.safe_load(ours(
        height=720, width=1280, intrinsics=files.K.tolist(), cam_from_world=files.CAMERA_FROM_BASE.tolist()
    ))))  # fmt: skip
    info = yaml.safe_load(camera_info(plain, "front"))
    assert info["distortion_coefficients"]["data"] == [0] * 5
    np.testing.assert_allclose(info["camera_matrix"]["data"], files.K.ravel(), rtol=1e-6)
    transform = yaml.safe_load(easy_handeye2(plain, "front"))["transform"]
    np.testing.assert_allclose(list(transform["translation"].values()), files.T, atol=1e-6)
    with pytest.raises(CalibrationError, match="no camera 'side'"):
        camera_info(plain, "side")


def test_readings_name_only_what_a_file_does_not_say(write):
    from lerobot_symview.calibration.formats.facts import Pose

    pose = Pose(np.array([0, 0, 0, 1.0]), np.zeros(3), "camera_to_base", "optical", None, 1.0)
    assert list(readings(pose, PoseReading())) == ["quaternion xyzw", "quaternion wxyz"]
    assert list(readings(pose, PoseReading(quaternion_order="wxyz"))) == [""]


CASES = {
    "ros_camera_info.yaml": "image_width: 1280\nimage_height: 720\ncamera_name: front\ncamera_matrix:\n  rows: 3\n"
    "  cols: 3\n  data: [631.54, 0., 638.43, 0., 631.20, 366.49, 0., 0., 1.]\ndistortion_model: plumb_bob\n"
    "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.09, -0.18, 0.0005, -0.0003, 0.06]\n",
    "opencv.yaml": "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    "   data: [ 631.54, 0., 638.43, 0., 631.20, 366.49, 0., 0., 1. ]\n"
    "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n"
    "   data: [ 0.09, -0.18, 0.0005, -0.0003, 0.06 ]\n",
    "kalibr.yaml": "cam0:\n  camera_model: pinhole\n  intrinsics: [631.54, 631.20, 638.43, 366.49]\n"
    "  distortion_model: radtan\n  distortion_coeffs: [-0.05, 0.02, 0.0003, -0.0002]\n  resolution: [1280, 720]\n",
    "realsense.json": '{"width": 1280, "height": 720, "ppx": 638.43, "ppy": 366.49, "fx": 631.54, "fy": 631.20,'
    ' "model": "Brown Conrady", "coeffs": [0,0,0,0,0]}',
}
POSES = {
    "easy_handeye2.calib": "parameters:\n  calibration_type: eye_on_base\n  robot_base_frame: panda_link0\n"
    "  tracking_base_frame: camera_color_optical_frame\ntransform:\n  translation: {x: 1.02, y: 0.03, z: 0.57}\n"
    "  rotation: {x: 0.65, y: 0.65, z: -0.27, w: -0.27}\n",
    "droid.json": '{"12345678_left": {"pose": [0.2, 0.5, 0.45, -1.9, 0.02, -2.2], "timestamp": 1680000000.0}}',
}


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("intrinsics", CASES)
def test_files_as_tools_write_them_are_joined(write, intrinsics, pose):
    sources = [write(intrinsics, CASES[intrinsics]), write(pose, POSES[pose])]
    entries = convert(sources, "front", SIZE)["cameras"]["front"]
    np.testing.assert_allclose(entries["intrinsics"], [[631.54, 0, 638.43], [0, 631.2, 366.49], [0, 0, 1]])
    x, y, z = np.array(entries["world_from_cam"])[:3, 3]
    assert [x, y, z] == ([1.02, 0.03, 0.57] if pose.startswith("easy") else [0.2, 0.5, 0.45])
    for source in sources:
        with pytest.raises(CalibrationError, match="add a file with"):
            convert([source], "front", SIZE)


DEPTH = {"640x576": {"intrinsic": {"fx": 500.0, "fy": 501.0, "cx": 320.5, "cy": 287.5}}}
SENSOR = {"intrinsics": [500.0, 501.0, 320.5, 287.5], "position": [-32.1, 0.5, 1.5], "quaternion_xyzw": [0, 0, 0, 1]}


@pytest.mark.parametrize("source", ["orbbec", "ours"])
@pytest.mark.parametrize("pose_units", ["m", "mm"])
def test_the_place_of_a_depth_sensor_keeps_its_unit_whatever_the_pose_has(write, source, pose_units):
    pose = orbit_pose(0.8, 0.3, 0.9, (0.45, 0.0, 0.0))
    pose[:3, 3] *= {"m": 1, "mm": 1000}[pose_units]
    placed = {"units": pose_units, "cameras": {"front": {"world_from_cam": pose.tolist()}}}
    given = [write("pose.yaml", yaml.safe_dump(placed)), write("k.json", files.orbbec(depth=DEPTH))]
    if source == "ours":
        given[1] = write("k.json", files.realsense(coeffs=[0] * 5))
        given.append(
            write("depth.yaml", yaml.safe_dump({"units": "mm", "cameras": {"front": {"depth_sensor": SENSOR}}}))
        )
    camera = parse_calibration(convert(given, "front", SIZE, Workspace())).camera("front")
    np.testing.assert_allclose(camera.depth_sensor.color_from_depth[:3, 3], [-0.0321, 0.0005, 0.0015], atol=1e-7)
    np.testing.assert_allclose(camera.depth_sensor.intrinsics[:2, 2], [320.5, 287.5])
    again = parse_calibration(plain_calibration(parse_calibration(convert(given, "front", SIZE, Workspace()))))
    np.testing.assert_array_equal(
        again.camera("front").depth_sensor.color_from_depth, camera.depth_sensor.color_from_depth
    )


def test_depth_of_several_sizes_gives_no_depth_sensor(write):
    several = DEPTH | {"320x288": DEPTH["640x576"]}
    placed = {"units": "m", "cameras": {"front": {"world_from_cam": orbit_pose(0.8, 0, 0.9, (0.45, 0, 0)).tolist()}}}
    given = [write("pose.yaml", yaml.safe_dump(placed)), write("k.json", files.orbbec(depth=several))]
    assert parse_calibration(convert(given, "front", SIZE, Workspace())).camera("front").depth_sensor is None
