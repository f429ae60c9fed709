"""Files of every format give the camera that they were written from; malformed ones are errors in words."""

import json

import numpy as np
import pytest
import yaml

from lerobot_symview.calibration.convert import convert
from lerobot_symview.calibration.file import parse_calibration
from lerobot_symview.calibration.formats import FORMATS, parse, recognise
from lerobot_symview.calibration.formats.document import read_document
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.errors import CalibrationError
from tests.lerobot_symview.calibration.formats import files

SIZE = (files.HEIGHT, files.WIDTH)
FISHEYE = [0.1, 0.02, -0.003, 0.0004]


@pytest.fixture
def write(tmp_path):
    """A function that writes a file, without an extension that would tell its format."""

    def write(content, name="file"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def facts_of(path, size=SIZE):
    document = read_document(path)
    return next(iter(parse(document, recognise(document), size).values()))


def test_every_format_has_files():
    assert set(files.FILES) == set(FORMATS)


@pytest.mark.parametrize(("name", "variant"), files.VARIANTS)
def test_a_file_is_recognised_by_its_content_as_one_format(write, name, variant):
    document = read_document(write(files.FILES[name][variant]()))
    assert recognise(document) is FORMATS[name]


@pytest.mark.parametrize(("name", "variant"), [each for each in files.VARIANTS if each[0] != "lerobot_motors"])
def test_a_file_gives_the_camera_that_it_was_written_from(write, name, variant):
    """What the file lacks comes from a second file, and from the image size and the workspace."""
    sources = [write(files.FILES[name][variant]())]
    facts = facts_of(sources[0])
    if facts.intrinsics is None:
        sources.append(write(files.realsense(coeffs=[0] * 5), "intrinsics"))
    if facts.pose is None:
        sources.append(write(files.handeye2(), "pose"))
    camera = "left" if name == "zed" else "front"
    converted = convert(sources, camera, SIZE, files.WORKSPACE)
    read = parse_calibration(converted).camera(camera)
    expected = files.K.copy()
    if variant == "mujoco":  # a vertical field of view alone: square pixels, principal point in the middle
        expected = np.array([[files.FY, 0, 639.5], [0, files.FY, 359.5], [0, 0, 1]])
    np.testing.assert_allclose(read.intrinsics, expected, rtol=1e-6)
    np.testing.assert_allclose(read.world_from_cam, files.BASE_FROM_CAMERA, atol=1e-6)
    assert (read.height, read.width) == SIZE
    if facts.distortion:
        np.testing.assert_allclose(read.lens.coefficients, facts.distortion, rtol=1e-6)
    assert list(converted["cameras"]) == [camera]


@pytest.mark.parametrize(
    ("name", "model", "coefficients"),
    [
        ("opencv_file_storage", "plumb_bob", files.LENS),
        ("camera_info", "plumb_bob", files.LENS),
        ("camera_matrix", "plumb_bob", files.LENS),
        ("kalibr", "plumb_bob", files.LENS_OF_FOUR),
        ("umi", "equidistant", FISHEYE),
        ("realsense", "plumb_bob", files.LENS),
        ("orbbec", "plumb_bob", files.LENS),
        ("zed", "plumb_bob", files.LENS),
        ("azure_kinect", "rational_polynomial", [*files.LENS, 0.01, 0.02, 0.03]),
    ],
)
def test_a_lens_has_the_order_of_opencv(write, name, model, coefficients):
    facts = facts_of(write(next(iter(files.FILES[name].values()))()))
    assert facts.distortion_model == model
    np.testing.assert_allclose(facts.distortion, coefficients)


@pytest.mark.parametrize(("name", "unit"), [("bop", 1e-4)])
def test_a_depth_unit_is_in_metres(write, name, unit):
    assert facts_of(write(files.bop())).depth_unit == pytest.approx(unit)


def test_color_from_depth_of_orbbec_is_in_metres(write):
    facts = facts_of(write(files.orbbec()))
    np.testing.assert_allclose(facts.color_from_depth[:3, 3], [-0.0321, 0.0005, 0.0015])


def test_both_axes_of_maniskill_give_the_same_pose(write):
    pose = files.BASE_FROM_CAMERA.copy()
    pose[:3, :3] = files.R @ np.diag([1, -1, -1])
    file = write(json.dumps({"cam2world_gl": pose.tolist(), **json.loads(files.maniskill())}))
    only = json.loads(file.read_text())
    del only["extrinsic_cv"]
    for content in (json.loads(file.read_text()), only):
        read = parse_calibration(convert([write(json.dumps(content))], "front", SIZE)).camera("front")
        np.testing.assert_allclose(read.world_from_cam, files.BASE_FROM_CAMERA, atol=1e-6)


def test_a_calibration_is_read_in_one_call(write):
    read = read_calibration([write(files.bop(), "pose")], "front", SIZE)
    np.testing.assert_allclose(read.camera("front").world_from_cam, files.BASE_FROM_CAMERA, atol=1e-6)
    assert read.depth_units == {"front": pytest.approx(1e-4)}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (files.lerobot_motors(), "calibrates the robot's motors, not a camera"),
        (files.camera_info(camera_matrix=files.matrix(np.zeros((3, 3)))), "never calibrated"),
        (files.camera_info(distortion_model="thin_prism"), "lens model 'thin_prism' is not supported"),
        (files.handeye2(calibration_type="eye_in_hand"), "on the robot's hand"),
        (files.handeye(eye_on_hand=True), "on the robot's hand"),
        (files.kalibr(camera_model="omni"), "camera model 'omni' is not supported"),
        (files.kalibr(distortion_coeffs=[0.1]), "distortion_coeffs must be 4 finite numbers"),
        (files.realsense(model="Inverse Brown Conrady"), "'inverse brown conrady' is not supported"),
        (files.savetxt(np.eye(3)[:, ::-1]), "a 3 x 3 matrix must be K"),
        (files.savetxt([0.0012]), "got 1 numbers"),
        (files.savetxt(np.ones((4, 4))), "last row"),
        (json.dumps({"a": {"pose": [0] * 6}, "b": {"pose": [0] * 6}}), "has the cameras a, b: none is 'front'"),
        ("units: m", "cameras must be a mapping"),
        ("just: a mapping", "or a file of .*ROS camera_info"),
        ("%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n", "OpenCV FileStorage"),
        ('<?xml version="1.0"?><opencv_storage><K type_id="opencv-matrix"><rows>3</rows>', "OpenCV FileStorage"),
    ],
)
def test_a_file_that_cannot_be_used_says_why(write, content, message):
    with pytest.raises(CalibrationError, match=f"file.*{message}"):
        read_calibration(write(content), "front", SIZE, files.WORKSPACE)


def test_a_camera_that_moves_is_refused(write):
    content = json.loads(files.bop())
    content["1"]["cam_t_w2c"][0] += 1
    with pytest.raises(CalibrationError, match="moves or changes over its 2 images"):
        read_calibration(write(json.dumps(content)), "front", SIZE)


def test_sizes_are_listed_where_none_is_the_images(write):
    with pytest.raises(CalibrationError, match="640 x 360, 1280 x 720: none is 640 x 480"):
        read_calibration(write(files.orbbec()), "front", (480, 640))


def damaged(content):
    """Yield the text of a file cut off, with a part repeated, and with one of its numbers replaced."""
    if isinstance(content, bytes):
        yield from (content[: len(content) * part // 8] for part in range(1, 8))
        yield content[:100] + b"\xff" * 20 + content[120:]
        return
    yield from (content[: len(content) * part // 8] for part in range(1, 8))
    yield content.replace("0", "nan")
    yield content.replace(".", "x")
    yield content.replace(":", ": [] #") if ":" in content else content * 3
    yield content.replace("[", "{")
    yield content.replace("{", "[").replace("}", "]")


def broken(value):
    """Yield JSON-like content with each of its entries replaced by a value of another type, or left out."""
    keys = value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for key in list(keys)[:5]:
        copy = json.loads(json.dumps(value))
        for wrong in (None, "text", {}, [[1, 2], [3]], float("nan")):
            copy[key] = wrong
            yield copy
        if isinstance(value, dict):
            yield {other: entry for other, entry in value.items() if other != key}
        for inner in broken(value[key]):
            yield copy | {key: inner} if isinstance(copy, dict) else [*value[:key], inner, *value[key + 1 :]]


@pytest.mark.parametrize(("name", "variant"), files.VARIANTS)
def test_a_malformed_file_is_a_calibration_error_or_valid(write, name, variant):
    """Never another error: a part that is left out, such as a lens, may leave a valid file."""
    content = files.FILES[name][variant]()
    texts = list(damaged(content))
    if isinstance(content, str) and not any(mark in content for mark in ("opencv", "<", "[LEFT")):
        texts += [json.dumps(each) for each in broken(yaml.safe_load(content))]
    if isinstance(content, bytes):
        texts.append(content.replace(b"f8", b"O8").replace(b"f4", b"O4"))
    refused = 0
    for text in texts:
        try:
            read_calibration(write(text), "front", SIZE, files.WORKSPACE)
        except CalibrationError as error:
            refused += str(error) != ""
    assert refused > len(texts) / 4


def test_a_huge_file_is_not_read(write):
    with pytest.raises(CalibrationError, match="more than 16 MB"):
        read_calibration(write(b"1 " * (9 * 2**20)))


def test_an_encrypted_archive_says_so(write):
    archive = bytearray(files.maniskill_npz())
    for header, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):  # in front of each member, and in the directory
        archive[archive.index(header) + flags] |= 1
    with pytest.raises(CalibrationError, match=r"encrypted.*save it with np\.savez"):
        read_calibration(write(bytes(archive)), "front", SIZE, files.WORKSPACE)
