"""Matrices of MuJoCo, robosuite and ManiSkill, in JSON, YAML or .npz; BOP's scene_camera.json; LeRobot's motors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lerobot_symview.calibration.formats.document import Document
from lerobot_symview.calibration.formats.facts import (
    BASE_TO_CAMERA,
    CAMERA_TO_BASE,
    OPENGL,
    OPTICAL,
    CameraFacts,
    Facts,
    Format,
    Pose,
    Size,
    intrinsics_matrix,
    matrix_pose,
    number,
    numbers,
    optional_size,
)
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Array, intrinsics_from_fov
from lerobot_symview.geometry.units import MILLIMETRES

MUJOCO = {"cam_xpos", "cam_xmat", "cam_fovy"}
SAPIEN = {"extrinsic_cv", "cam2world_gl", "intrinsic_cv"}


def _has_matrices(entries: Mapping[str, Any]) -> bool:
    return bool((MUJOCO | SAPIEN) & set(entries))


def _is_simulated(document: Document) -> bool:
    return bool(document.cameras(_has_matrices))


def _simulated(document: Document, size: Size | None) -> Facts:
    return {name: _camera(entries, size) for name, entries in document.cameras(_has_matrices).items()}


def _camera(entries: Mapping[str, Any], size: Size | None) -> CameraFacts:
    shape = optional_size(entries) or size
    intrinsics: Array | None = None
    if "intrinsic_cv" in entries:
        intrinsics = intrinsics_matrix("intrinsic_cv", entries["intrinsic_cv"])
        intrinsics[:2, 2] -= 0.5  # its centre of an image is width / 2: pixel centres are at 0.5
    elif "cam_fovy" in entries:
        if shape is None:
            raise CalibrationError("cam_fovy gives K with height and width of the image, which it lacks")
        intrinsics = intrinsics_from_fov(np.deg2rad(number("cam_fovy", entries["cam_fovy"])), *shape)
    return CameraFacts(intrinsics, shape, pose=_pose(entries))


def _pose(entries: Mapping[str, Any]) -> Pose | None:
    if "extrinsic_cv" in entries:
        return matrix_pose("extrinsic_cv", entries["extrinsic_cv"], BASE_TO_CAMERA, OPTICAL, 1.0)
    if "cam2world_gl" in entries:
        return matrix_pose("cam2world_gl", entries["cam2world_gl"], CAMERA_TO_BASE, OPENGL, 1.0)
    if "cam_xmat" not in entries and "cam_xpos" not in entries:
        return None
    rotation = numbers("cam_xmat", entries.get("cam_xmat"), 3, 3)
    return Pose(rotation, numbers("cam_xpos", entries.get("cam_xpos"), 3), CAMERA_TO_BASE, OPENGL, None, 1.0)


def _is_bop(document: Document) -> bool:
    return any(isinstance(value, Mapping) and "cam_K" in value for value in document.entries().values())


def _bop(document: Document, size: Size | None) -> Facts:
    """An entry for each image: the camera must not move. Millimetres; `depth_scale` times depth is millimetres."""
    images = [value for value in document.entries().values() if isinstance(value, Mapping) and "cam_K" in value]
    matrices, poses, scales = [], [], []
    for image in images:
        matrices.append(intrinsics_matrix("cam_K", image["cam_K"]))
        scales.append(number("depth_scale", image.get("depth_scale", 1)))
        if "cam_R_w2c" in image:
            rotation = numbers("cam_R_w2c", image["cam_R_w2c"], 3, 3)
            poses.append(np.column_stack([rotation, numbers("cam_t_w2c", image.get("cam_t_w2c"), 3)]))
    if any(not np.allclose(values, values[0]) for values in (matrices, poses, scales) if values):
        raise CalibrationError(f"the camera moves or changes over its {len(images)} images, expected one that stands")
    pose = Pose(poses[0][:, :3], poses[0][:, 3], BASE_TO_CAMERA, OPTICAL, None, MILLIMETRES) if poses else None
    return {"": CameraFacts(matrices[0], pose=pose, depth_unit=scales[0] * MILLIMETRES)}


def _is_motors(document: Document) -> bool:
    values = list(document.entries().values())
    return bool(values) and all(isinstance(value, Mapping) and "homing_offset" in value for value in values)


def _motors(document: Document, size: Size | None) -> Facts:
    raise CalibrationError("it calibrates the robot's motors, not a camera; expected a file with a camera's K or pose")


SIMULATED = Format("MuJoCo, robosuite or ManiSkill matrices", _is_simulated, _simulated)
BOP = Format("BOP scene_camera.json", _is_bop, _bop)
LEROBOT_MOTORS = Format("LeRobot's motor calibration", _is_motors, _motors)
