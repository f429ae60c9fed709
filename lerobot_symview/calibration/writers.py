"""Cameras of our own calibration file as files of ROS: camera_info and easy_handeye2."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from lerobot_symview.calibration.file import parse_calibration
from lerobot_symview.geometry.lens import PLUMB_BOB, Lens


def camera_info(content: Mapping[str, Any], name: str) -> str:
    """Return the YAML of ROS's camera_info: image size, K and lens of a camera.

    Args:
        content: of our own calibration file, as `convert` and `plain_calibration` return it.
        name: the camera's name.

    Raises:
        CalibrationError: if the content is invalid or has no such camera.
    """
    camera = parse_calibration(content).camera(name)
    lens = camera.lens or Lens(PLUMB_BOB, (0.0,) * 5)
    projection = np.column_stack([camera.intrinsics, np.zeros(3)])
    return yaml.safe_dump(
        {
            "image_width": camera.width,
            "image_height": camera.height,
            "camera_name": name,
            "camera_matrix": _matrix(camera.intrinsics),
            "distortion_model": lens.model,
            "distortion_coefficients": _matrix(np.array([lens.coefficients])),
            "rectification_matrix": _matrix(np.eye(3)),
            "projection_matrix": _matrix(projection),
        },
        sort_keys=False,
        default_flow_style=None,
    )


def easy_handeye2(content: Mapping[str, Any], name: str, base: str = "base_link") -> str:
    """Return the YAML of easy_handeye2: the pose of a camera beside the table, with optical axes.

    Args:
        content: of our own calibration file, as `convert` and `plain_calibration` return it.
        name: the camera's name.
        base: name of the world's frame.

    Raises:
        CalibrationError: if the content is invalid or has no such camera.
    """
    pose = parse_calibration(content).camera(name).world_from_cam
    x, y, z, w = map(float, Rotation.from_matrix(pose[:3, :3]).as_quat())
    return yaml.safe_dump(
        {
            "parameters": {
                "name": name,
                "calibration_type": "eye_on_base",
                "robot_base_frame": base,
                "tracking_base_frame": f"{name}_optical_frame",
            },
            "transform": {
                "translation": {axis: float(value) for axis, value in zip("xyz", pose[:3, 3], strict=True)},
                "rotation": {"x": x, "y": y, "z": z, "w": w},
            },
        },
        sort_keys=False,
        default_flow_style=None,
    )


def _matrix(matrix: np.ndarray) -> dict[str, Any]:
    rows, columns = matrix.shape
    return {"rows": rows, "cols": columns, "data": matrix.ravel().tolist()}


WRITERS = {"camera_info": camera_info, "easy_handeye2": easy_handeye2}
"""Name of a format -> writer of a camera in it."""
