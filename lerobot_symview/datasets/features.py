"""LeRobot feature declarations of cameras and views.

LeRobot merges only datasets whose declarations are equal, so `info["symview"]` holds what an image means, such as the
workspace and a view's options, and nothing that may differ between recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lerobot_symview import keys
from lerobot_symview.errors import CalibrationError, DatasetError
from lerobot_symview.geometry.gripper_state import gripper_columns
from lerobot_symview.geometry.lens import STORED
from lerobot_symview.geometry.units import UNIT_NAMES
from lerobot_symview.geometry.workspace import Workspace

if TYPE_CHECKING:
    from lerobot_symview.geometry.camera import Camera
    from lerobot_symview.views import View

Features = dict[str, dict[str, Any]]
TURNING = ("yaw", "rx", "ry", "rz", "wx", "wy", "wz", "roll", "pitch")  # names of what turns a gripper
IMAGE_AXES = ["height", "width", "channels"]


def color_feature(height: int, width: int, meaning: dict[str, Any]) -> dict[str, Any]:
    """Declare a uint8 RGB image; `meaning` is stored under `info["symview"]`."""
    return {"dtype": "image", "shape": (height, width, 3), "names": IMAGE_AXES, "info": {"symview": meaning}}


def metric_feature(height: int, width: int, meaning: dict[str, Any]) -> dict[str, Any]:
    """Declare a float32 image in metres, stored losslessly; `meaning` is stored under `info["symview"]`."""
    info = {"is_depth_map": True, "depth_unit": "m", "symview": meaning}
    return {"dtype": "image", "shape": (height, width, 1), "names": IMAGE_AXES, "info": info}


def camera_features(
    name: str,
    height: int,
    width: int,
    workspace: Workspace,
    *,
    depth: bool = True,
    segmentation: bool = False,
    lens: bool = False,
) -> Features:
    """Declare the colour image and calibration of one camera, and optionally its depth, segmentation and lens."""
    meaning = {"workspace": asdict(workspace)}
    features = {keys.rgb(name): color_feature(height, width, meaning)}
    if depth:
        features[keys.depth(name)] = metric_feature(height, width, meaning)
    if segmentation:
        labels = {"labels": {"0": "table", "1": "robot", "2 and up": "objects"}}
        features[keys.segmentation(name)] = color_feature(height, width, meaning | labels)
    return features | calibration_features(name, lens=lens)


def calibration_features(name: str, *, lens: bool = False, depth_sensor: bool = False) -> Features:
    """Declare the calibration of one camera, and optionally its lens and its depth sensor."""
    matrix = {"dtype": "float32", "shape": (9,), "names": [f"k{i}{j}" for i in range(3) for j in range(3)]}
    pose = {"dtype": "float32", "shape": (16,), "names": [f"t{i}{j}" for i in range(4) for j in range(4)]}
    features: Features = {keys.intrinsics(name): matrix, keys.world_from_cam(name): pose}
    if depth_sensor:
        features |= {keys.depth_intrinsics(name): dict(matrix), keys.color_from_depth(name): dict(pose)}
    if lens:
        # The model is a number of the column, and every model has as many, so that datasets with any lenses merge.
        names = ["model", *(f"d{index}" for index in range(1, STORED))]
        features[keys.distortion(name)] = {"dtype": "float32", "shape": (STORED,), "names": names}
    return features


def calibration_vectors(name: str, camera: Camera) -> dict[str, NDArray[np.float32]]:
    """Return a camera's calibration as it is stored: feature -> flat float32 numbers."""
    numbers = {keys.intrinsics: camera.intrinsics, keys.world_from_cam: camera.world_from_cam}
    if camera.lens is not None:
        numbers[keys.distortion] = camera.lens.stored()
    if camera.depth_sensor is not None:
        numbers[keys.depth_intrinsics] = camera.depth_sensor.intrinsics
        numbers[keys.color_from_depth] = camera.depth_sensor.color_from_depth
    return {key(name): values.astype(np.float32).ravel() for key, values in numbers.items()}


def view_features(camera: str, name: str, view: View, workspace: Workspace) -> Features:
    """Declare the outputs of `view`; the camera's images and calibration and `info["symview"]` render them again."""
    meaning = {"view": name, "camera": camera, "options": asdict(view), "workspace": asdict(workspace)}
    declare = {"rgb": color_feature, "height": metric_feature}
    return {
        keys.view(camera, output): declare[kind](view.size, view.size, meaning) for output, kind in view.outputs.items()
    }


def declared_unit(feature: dict[str, Any]) -> float | None:
    """Return the metres per unit of a depth feature by LeRobot's `info["depth_unit"]`; None if it declares none.

    Raises:
        DatasetError: if the unit is neither `m` nor `mm`.
    """
    unit = (feature.get("info") or {}).get("depth_unit")
    if unit is not None and unit not in UNIT_NAMES:
        raise DatasetError(f"depth_unit must be one of {', '.join(UNIT_NAMES)}, got {unit!r}")
    return None if unit is None else UNIT_NAMES[unit]


def image_size(features: Features, key: str) -> tuple[int, int] | None:
    """Return rows and columns of an image feature, declared with channels first or last; None without the feature."""
    if key not in features:
        return None
    shape = features[key]["shape"]
    height, width = shape[1:] if shape[0] in (1, 3) else shape[:2]
    return height, width


def check_depth_size(camera: str, depth: Sequence[int], color: Sequence[int]) -> None:
    """Raise a DatasetError unless the depth images of a camera have the size of its colour images.

    Args:
        camera: name of the camera.
        depth: rows and columns of depth, as a feature's shape.
        color: rows and columns of colour.
    """
    if tuple(depth[:2]) != tuple(color[:2]):
        raise DatasetError(
            f"{keys.depth(camera)} has {depth[0]} x {depth[1]} pixels, {keys.rgb(camera)} has {color[0]} x {color[1]}: "
            "give the depth sensor's calibration, `depth_sensor` in the calibration file, or align depth to colour "
            "when recording, as rs.align(rs.stream.color) does for a RealSense"
        )


def stored_workspace(features: Features) -> Workspace:
    """Return the workspace that a dataset declares; the default workspace if it declares none."""
    from lerobot_symview.calibration.file import parse_workspace

    for key, feature in features.items():
        meaning = (feature.get("info") or {}).get("symview", {})
        if "workspace" in meaning:
            try:
                return parse_workspace(meaning["workspace"])
            except CalibrationError as error:
                raise CalibrationError(f"the workspace declared by {key}: {error}") from None
    return Workspace()


def is_depth_feature(feature: dict[str, Any]) -> bool:
    """Whether a feature declares depth or height images."""
    return bool((feature.get("info") or {}).get("is_depth_map"))


def names_of(features: Features, key: str) -> list[str]:
    """Return the names of a vector's dimensions; empty if the dataset does not name them."""
    names = features.get(key, {}).get("names")
    return names if isinstance(names, list) and all(isinstance(name, str) for name in names) else []


def gripper_dimensions(features: Features, state: Sequence[str] | None = None) -> list[int | None] | None:
    """Return where a state has the gripper's pose, as `gripper_columns` does; None if it is unknown.

    Args:
        features: a dataset's.
        state: names of the state's dimensions; by default the dataset's.
    """
    turns = any(name.removeprefix("ee.").removeprefix("d") in TURNING for name in names_of(features, keys.ACTION))
    return gripper_columns(names_of(features, keys.STATE) if state is None else state, turns)
