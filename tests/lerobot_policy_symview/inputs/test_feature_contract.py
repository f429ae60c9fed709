"""The calibration that a policy reads from its training dataset."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_policy_symview.inputs.feature_contract import read_calibration, read_features
from lerobot_symview import keys
from lerobot_symview.calibration.file import Calibration, parse_calibration, plain_calibration
from lerobot_symview.datasets.metadata import ADDED_VIEWS
from lerobot_symview.errors import CalibrationError
from lerobot_symview.runtime.flag_errors import FlagError
from tests.helpers.cameras import make_camera
from tests.helpers.policies import make_config

CAMERA = make_camera(size=32)
FILE = plain_calibration(Calibration({"side": CAMERA, "other": make_camera(azimuth=90.0)}))
IMAGE = {keys.rgb("side"): {"dtype": "image", "shape": (32, 32, 3)}}


def metadata(folder, features=IMAGE, moved=0.0, intrinsics=CAMERA.intrinsics):
    """Metadata of a dataset whose camera moved by some metres along x."""
    pose = CAMERA.world_from_cam.ravel()
    farthest = pose + moved * np.eye(16)[3]
    stats = {
        keys.intrinsics("side"): {"min": intrinsics.ravel(), "max": intrinsics.ravel()},
        keys.world_from_cam("side"): {"min": pose, "max": farthest},
    }
    return SimpleNamespace(root=folder, features=features, stats=stats)


def calibration_of(meta, **options):
    config = make_config(**options)
    config._runtime_dataset_meta = meta
    read_calibration(config)
    return config.calibration


def test_the_calibration_of_a_fixed_camera_is_read(tmp_path):
    camera = parse_calibration(calibration_of(metadata(tmp_path))).camera("side")
    np.testing.assert_array_equal(camera.world_from_cam, CAMERA.world_from_cam.astype(np.float32))
    np.testing.assert_array_equal(camera.intrinsics, CAMERA.intrinsics.astype(np.float32))
    assert (camera.height, camera.width) == (32, 32)


def test_a_camera_that_moved_has_no_calibration(tmp_path):
    assert calibration_of(metadata(tmp_path, moved=0.02)) == {}
    assert calibration_of(metadata(tmp_path, moved=0.02), calibration=FILE) == FILE


def test_a_dataset_without_calibration_leaves_the_configuration_unchanged(tmp_path):
    assert calibration_of(SimpleNamespace(root=tmp_path, features=IMAGE, stats=None)) == {}


def test_the_image_size_of_views_alone_is_that_of_the_calibration_file(tmp_path):
    meta = metadata(tmp_path, features={})
    assert calibration_of(meta) == {}
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / ADDED_VIEWS).write_text(json.dumps({"calibration": FILE}))
    assert list(parse_calibration(calibration_of(meta)).cameras) == ["side"]


def test_an_invalid_calibration_is_an_error_where_it_is_used(tmp_path):
    meta = metadata(tmp_path, intrinsics=np.zeros((3, 3)))
    with pytest.raises(CalibrationError, match="the dataset's calibration of camera 'side'"):
        calibration_of(meta)
    assert calibration_of(meta, method="sideview_equi") == {}


def with_vectors(state, action):
    """Features of a camera, a state and an action with named dimensions."""
    features = {keys.rgb("side"): {"dtype": "image", "shape": (76, 76, 3)}}
    features |= {keys.depth("side"): {"dtype": "image", "shape": (76, 76, 1), "info": {"is_depth_map": True}}}
    named = ((keys.STATE, state), (keys.ACTION, action))
    return features | {key: {"dtype": "float32", "shape": (len(names),), "names": names} for key, names in named}


def test_the_types_of_state_and_action_are_read_from_their_names():
    config = make_config()
    read_features(config, with_vectors(["z", "x", "y", "aperture"], ["dx", "dy", "dz", "aperture"]))
    assert config.state_symmetry == ["z", "x", "y", "aperture"]
    assert config.action_symmetry == ["x", "y", "z", "aperture"]
    assert config.gripper_indices == [1, 2, 0, None, 3]
    assert config.view.options.get("clip", "gripper") == "gripper"


def test_declared_types_take_precedence_over_names():
    config = make_config(state_symmetry=["x", "y", "z", "scalar"], action_symmetry=["x", "y", "z", "scalar"])
    read_features(config, with_vectors(["x", "y", "z", "aperture"], ["dx", "dy", "dz", "aperture"]))
    assert config.state_symmetry == config.action_symmetry == ["x", "y", "z", "scalar"]


def test_an_origin_is_of_the_declared_positions_whatever_their_names():
    types = ["x", "y", "z", "aperture"]
    config = make_config(state_symmetry=types, action_symmetry=types, state_origin="world")
    read_features(config, with_vectors(["ee_x", "ee_y", "ee_z", "grip"], ["dx", "dy", "dz", "aperture"]))
    assert config.state_names == ["x", "y", "z", "aperture"]
    assert config.state_reader.converts
    without = make_config(state_symmetry=["scalar"] * 4, gripper_input="vector", state_origin="world")
    with pytest.raises(ValueError, match=r"state_origin=world is of the gripper's position; .* lacks x, y, z"):
        read_features(without, with_vectors(["a", "b", "c", "d"], ["dx", "dy", "dz", "aperture"]))


@pytest.mark.parametrize("turning", [["rx", "ry", "sign"], ["yaw"]])
def test_a_gripper_that_turns_needs_its_yaw(turning):
    options = {"state_symmetry": ["x", "y", "z", "aperture"], "action_symmetry": ["x", "y", "z", *turning, "aperture"]}
    with pytest.raises(FlagError, match=r"gripper_input=image draws the gripper; .* lacks yaw, .* turns it: use"):
        make_config(**options)


def test_the_message_suggests_one_type_for_each_of_the_datasets_dimensions():
    features = with_vectors(["x", "y", "z", "grip"], ["dx", "dy", "dz", "aperture"])
    with pytest.raises(ValueError, match=r"has 4 \(x, y, z, grip\): .*state_symmetry='\[x, y, z, scalar\]'"):
        read_features(make_config(), features)


@pytest.mark.parametrize("method", ["sideview_equi", "point_cloud_equi", "voxel_equi"])
@pytest.mark.parametrize("has_sensor", [True, False], ids=["with a sensor's calibration", "of another size"])
def test_methods_that_read_raw_depth_refuse_depth_that_is_not_aligned(method, has_sensor):
    vectors = {"dtype": "float32", "shape": (5,)}
    depth = {"dtype": "image", "shape": (76, 76, 1) if has_sensor else (60, 76, 1), "info": {"is_depth_map": True}}
    features = {keys.rgb("side"): {"dtype": "image", "shape": (76, 76, 3)}, keys.depth("side"): depth}
    features |= {keys.STATE: vectors | {"names": keys.STATE_NAMES}, keys.ACTION: vectors | {"names": keys.ACTION_NAMES}}
    features |= {key: {"dtype": "float32", "shape": (9,)} for key in [keys.depth_intrinsics("side")] if has_sensor}
    reason = "the dataset has" if has_sensor else "it has"
    with pytest.raises(ValueError, match=f"--policy.method={method} reads .*not aligned with colour, since {reason}"):
        read_features(make_config(method=method), features)


def test_methods_that_read_raw_depth_refuse_a_calibration_with_a_depth_sensor():
    sensor = {"depth_sensor": {"intrinsics": [30, 30, 15.5, 15.5], "color_from_depth": np.eye(4).tolist()}}
    calibration = FILE | {"cameras": {"side": FILE["cameras"]["side"] | sensor}}
    features = {keys.rgb("side"): {"dtype": "image", "shape": (76, 76, 3)}}
    features |= {keys.depth("side"): {"dtype": "image", "shape": (76, 76, 1), "info": {"is_depth_map": True}}}
    vectors = {"dtype": "float32", "shape": (5,)}
    features |= {keys.STATE: vectors | {"names": keys.STATE_NAMES}, keys.ACTION: vectors | {"names": keys.ACTION_NAMES}}
    with pytest.raises(ValueError, match=r"not aligned with colour, since --policy\.calibration has a depth_sensor"):
        read_features(make_config(method="sideview_equi", calibration=calibration), features)
