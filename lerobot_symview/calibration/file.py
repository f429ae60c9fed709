"""Camera calibration from a file, for datasets and robots that do not store it.

Matrices and lenses are rounded to float32, the precision of datasets, so that views rendered with the numbers of the
file and of a dataset are bit-identical. In place of `world_from_cam` the file may have its inverse,
`cam_from_world`, or `position` and `quaternion_xyzw` of the camera in the world.

With `robot_base`, everything is moved to the base's axes, with the origin on the table below it: cameras and
workspace then fit states and actions in the frame of the base. With `table_height`, the table is moved to z = 0. A
calibration that was moved so is written with `origin_height`, the height above the table of what states count from.

The file is YAML or JSON:

    units: m                        # of the translations, m or mm; K is in pixels
    workspace:                      # the square on the table that views show, metres; optional
      center: [0.45, 0.0]
      size: 0.4
      table_height: 0.0             # of the table in the world, metres; optional
    robot_base:                     # pose of the robot's base in the world, for states that count from it; optional
      position: [0.1, -0.3, 0.02]
      yaw_deg: 90                   # about the vertical
    cameras:
      front:                        # as in observation.images.front
        height: 480
        width: 640
        intrinsics: [615.3, 615.1, 319.5, 239.5]      # fx, fy, cx, cy; or the 3 x 3 matrix K
        world_from_cam:             # OpenCV axes; the world's z axis points up and its table is z = 0
          - [0,  0.70711, -0.70711, 1.02]
          - [1,  0,        0,       0   ]
          - [0, -0.70711, -0.70711, 0.57]
        distortion: [0.09, -0.18, 0.0005, -0.0003, 0.06]      # k1, k2, p1, p2, k3, as OpenCV orders them; optional
        distortion_model: plumb_bob # or rational_polynomial, equidistant (fisheye); by default by the count, 4, 5 or 8
        depth_unit: mm              # m, mm, or metres per unit such as 0.0001; optional
        depth_sensor:               # where depth is not aligned with colour; the size is that of the depth images
          intrinsics: [385.2, 385.2, 320.1, 238.7]
          color_from_depth:         # or position and quaternion_xyzw of the depth sensor in the colour camera's frame
            - [1, 0, 0, 0.0148]
            - [0, 1, 0, 0.0001]
            - [0, 0, 1, 0.0003]
"""

from __future__ import annotations

import logging
from collections.abc import Container, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from lerobot_symview.errors import CalibrationError, OptionError
from lerobot_symview.geometry.camera import Array, Camera, DepthSensor, invert_rigid
from lerobot_symview.geometry.gripper_state import REQUIRED as REQUIRED_POSITION
from lerobot_symview.geometry.lens import Lens, lens_from_coefficients
from lerobot_symview.geometry.state_reader import StateOrigin
from lerobot_symview.geometry.units import parse_unit
from lerobot_symview.geometry.workspace import Workspace

logger = logging.getLogger(__name__)

METRES = {"m": 1.0, "mm": 0.001}
REQUIRED = ("height", "width", "intrinsics")
POSES = ("world_from_cam", "cam_from_world", "position")
OPTIONAL = ("quaternion_xyzw", "depth_unit", "distortion", "distortion_model", "depth_sensor")
SENSOR_POSES = ("color_from_depth", "position")
HIGHEST = 3.0  # metres of a robot's base above the table, or below it
ROUNDED = 0.01  # largest deviation from a rotation, as of a matrix printed with two decimals


@dataclass(frozen=True)
class Calibration:
    """Fixed cameras by name; the workspace, the depth units in metres per unit, and the robot's base, if declared."""

    cameras: dict[str, Camera]
    workspace: Workspace | None = None
    depth_units: dict[str, float] = field(default_factory=dict)
    origin_height: float = 0.0
    """Height above the table of the origin that states count from, the file's world or the robot's base, metres."""
    is_in_base_axes: bool = False
    """Whether the file has `robot_base`, so that cameras and workspace are in the axes of the base."""

    def camera(self, name: str) -> Camera:
        """Return the camera `name`.

        Raises:
            CalibrationError: if the calibration has no such camera.
        """
        if name not in self.cameras:
            raise CalibrationError(f"the calibration has no camera {name!r}; it has {', '.join(self.cameras)}")
        return self.cameras[name]


def parse_calibration(content: Any) -> Calibration:
    """Return the calibration that the content of a file describes.

    Raises:
        CalibrationError: if the content is invalid; one message lists all problems.
    """
    if not isinstance(content, Mapping):
        raise CalibrationError(f"expected a mapping with units and cameras, got {type(content).__name__}")
    problems = _unknown_keys("the file", content, ("units", "workspace", "robot_base", "origin_height", "cameras"))
    units = content.get("units")
    if not isinstance(units, str) or units not in METRES:
        problems.append(f"units must be m or mm, got {units!r}")
    named = content.get("cameras")
    if not isinstance(named, Mapping) or not named:
        problems.append("cameras must be a mapping with at least one camera")
        named = {}
    metres = METRES.get(str(units), 1.0)
    cameras, depth_units, workspace = {}, {}, None
    for name, entries in named.items():
        try:
            cameras[str(name)] = _camera(str(name), entries, metres)
            if entries.get("depth_unit") is not None:
                depth_units[str(name)] = parse_unit(entries["depth_unit"])
        except ValueError as error:
            problems.append(f"camera {name!r}: {error}")
    table_height = 0.0
    if content.get("workspace") is not None:
        try:
            entries, table_height = without_table_height(content["workspace"])
            workspace = None if entries == {} else parse_workspace(entries)
        except CalibrationError as error:
            problems.append(f"workspace: {error}")
    world_from_base, has_base = np.eye(4), content.get("robot_base") is not None
    if has_base:
        try:
            world_from_base = _base_pose(content["robot_base"], metres)
        except ValueError as error:
            problems.append(f"robot_base: {error}")
    try:
        (origin_height,) = _numbers("origin_height", content.get("origin_height", 0.0), (1,), "a number of metres")
    except CalibrationError as error:
        problems.append(str(error))
        origin_height = 0.0
    height = float(origin_height + world_from_base[2, 3] - table_height)
    if not abs(height) <= HIGHEST:
        problems.append(f"the states' origin must be within {HIGHEST:g} m of the table, got {height:.3g} m above it")
    if problems:
        raise CalibrationError("; ".join(problems))
    found = Calibration(cameras, workspace, depth_units, height, has_base)
    return _on_table(found, world_from_base, table_height)


def without_table_height(entries: Any) -> tuple[Any, float]:
    """Return the entries of `Workspace`, and the table's height in the world, metres."""
    if not isinstance(entries, Mapping) or "table_height" not in entries:
        return entries, 0.0
    (height,) = _numbers("table_height", entries["table_height"], (1,), "a number of metres")
    if not np.isfinite(height):
        raise CalibrationError(f"table_height must be finite, got {height}")
    return {name: value for name, value in entries.items() if name != "table_height"}, float(height)


def check_origin(calibration: Calibration, kind: StateOrigin | None, names: Sequence[str]) -> None:
    """Raise a CalibrationError if a file with `robot_base` is used for states that do not count from the base.

    Args:
        calibration: of the file.
        kind: what positions count from; None for the default of their names.
        names: of the state's dimensions.
    """
    has_position = set(REQUIRED_POSITION) <= set(names)
    if calibration.is_in_base_axes and (kind in ("world", "workspace") or (kind is None and has_position)):
        raise CalibrationError(
            f"robot_base moves the cameras to the axes of the base, but the state's positions count from the "
            f"{kind or 'workspace'}: state_origin must be base, or leave robot_base out"
        )


def _base_pose(entries: Any, metres: float) -> Array:
    """Return world_from_base (4, 4) of an upright base, metres."""
    if not isinstance(entries, Mapping) or set(entries) - {"position", "yaw_deg"}:
        raise CalibrationError(f"expected a mapping with position and yaw_deg, got {entries!r}")
    position = _numbers("position", entries.get("position", [0, 0, 0]), (3,), "three numbers x, y, z")
    (yaw,) = np.deg2rad(_numbers("yaw_deg", entries.get("yaw_deg", 0.0), (1,), "a number of degrees"))
    if not np.isfinite([*position, yaw]).all():
        raise CalibrationError(f"position and yaw_deg must be finite, got {entries!r}")
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = position * metres
    return pose


def _on_table(calibration: Calibration, world_from_base: Array, table_height: float) -> Calibration:
    """Return the calibration in a world with the base's axes, whose origin is on the table below the base."""
    if np.array_equal(world_from_base, np.eye(4)) and table_height == 0:
        return calibration
    below_base = world_from_base.copy()
    below_base[2, 3] = table_height
    moved = invert_rigid(below_base)
    cameras = {
        name: replace(camera, world_from_cam=_as_float32(moved @ camera.world_from_cam))
        for name, camera in calibration.cameras.items()
    }
    workspace = calibration.workspace
    if workspace is not None:
        x, y, _ = moved[:3, :3] @ [*workspace.center, 0.0] + moved[:3, 3]
        workspace = replace(workspace, center=(round(float(x), 9), round(float(y), 9)))
    return replace(calibration, cameras=cameras, workspace=workspace)


def parse_workspace(entries: Any) -> Workspace:
    """Return the workspace with the arguments of `Workspace` given in a mapping.

    Raises:
        CalibrationError: if an argument is unknown or invalid.
    """
    known = [field.name for field in fields(Workspace)]
    if not isinstance(entries, Mapping) or set(entries) - set(known):
        raise CalibrationError(f"expected a mapping with any of {', '.join(known)}, got {entries!r}")
    try:
        arguments: dict[str, Any] = {key: float(value) for key, value in entries.items() if key != "center"}
        if "center" in entries:
            x, y = map(float, entries["center"])
            return Workspace(center=(x, y), **arguments)
        return Workspace(**arguments)
    except (OptionError, TypeError, ValueError) as error:
        raise CalibrationError(str(error)) from None


def plain_calibration(calibration: Calibration) -> dict[str, Any]:
    """Return the calibration as JSON-compatible data that `parse_calibration` reads."""
    cameras = {
        name: {
            "height": camera.height,
            "width": camera.width,
            "intrinsics": camera.intrinsics.tolist(),
            "world_from_cam": camera.world_from_cam.tolist(),
            **plain_lens(camera.lens),
            **plain_depth_sensor(camera.depth_sensor),
            **({"depth_unit": calibration.depth_units[name]} if name in calibration.depth_units else {}),
        }
        for name, camera in calibration.cameras.items()
    }
    content: dict[str, Any] = {"units": "m", "cameras": cameras}
    if calibration.origin_height:
        content["origin_height"] = calibration.origin_height
    if calibration.is_in_base_axes:
        content["robot_base"] = {}  # everything is in its axes by now
    if calibration.workspace is not None:
        content["workspace"] = asdict(calibration.workspace) | {"center": list(calibration.workspace.center)}
    return content


def plain_lens(lens: Lens | None) -> dict[str, Any]:
    """Return the entries of a lens in a camera's mapping; none for a pinhole camera."""
    return {} if lens is None else {"distortion": list(lens.coefficients), "distortion_model": lens.model}


def plain_depth_sensor(sensor: DepthSensor | None) -> dict[str, Any]:
    """Return the entries of a depth sensor in a camera's mapping; none where depth is aligned with colour."""
    if sensor is None:
        return {}
    matrices = {"intrinsics": sensor.intrinsics, "color_from_depth": sensor.color_from_depth}
    return {"depth_sensor": {name: matrix.tolist() for name, matrix in matrices.items()}}


def _camera(name: str, entries: Any, metres: float) -> Camera:
    if not isinstance(entries, Mapping):
        raise CalibrationError(f"expected a mapping with {', '.join(REQUIRED)} and a pose, got {entries!r}")
    problems = _entry_problems(entries, REQUIRED, POSES, OPTIONAL)
    if problems:
        raise CalibrationError("; ".join(problems))
    for side in ("height", "width"):
        if not isinstance(entries[side], int) or entries[side] < 1:
            raise CalibrationError(f"{side} must be a positive number of pixels, got {entries[side]!r}")
    intrinsics, world_from_cam = _intrinsics(entries["intrinsics"]), _pose(name, entries, metres)
    lens = _lens(entries.get("distortion"), entries.get("distortion_model"))
    sensor = _depth_sensor(name, entries.get("depth_sensor"), metres)
    size = entries["height"], entries["width"]
    return Camera(_as_float32(intrinsics), _as_float32(world_from_cam), *size, lens, sensor)


def _entry_problems(
    entries: Mapping[str, Any], required: Sequence[str], poses: Sequence[str], optional: Sequence[str]
) -> list[str]:
    """Return which entries are unknown or missing, or give the pose twice; empty if there are no such problems."""
    problems = _unknown_keys("it", entries, (*required, *poses, *optional))
    missing = [entry for entry in required if entry not in entries]
    if missing:
        problems.append(f"lacks {', '.join(missing)}")
    given = [pose for pose in poses if pose in entries]
    if len(given) != 1:
        problems.append(f"expected one of {', '.join(poses)}, got {', '.join(given) or 'none'}")
    if ("position" in entries) != ("quaternion_xyzw" in entries):
        problems.append("position and quaternion_xyzw belong together")
    return problems


def _depth_sensor(name: str, entries: Any, metres: float) -> DepthSensor | None:
    if entries is None:
        return None
    if not isinstance(entries, Mapping):
        raise CalibrationError(f"depth_sensor must be a mapping with intrinsics and color_from_depth, got {entries!r}")
    problems = _entry_problems(entries, ("intrinsics",), SENSOR_POSES, ("quaternion_xyzw",))
    if problems:
        raise CalibrationError("depth_sensor: " + "; ".join(problems))
    color_from_depth = _pose(name, entries, metres)
    return DepthSensor(_as_float32(_intrinsics(entries["intrinsics"])), _as_float32(color_from_depth))


def _intrinsics(value: Any) -> Array:
    """Return K (3, 3) from a matrix, from fx, fy, cx, cy, or from a mapping with these names."""
    if isinstance(value, Mapping):
        value = [value.get(name) for name in ("fx", "fy", "cx", "cy")]
    numbers = _numbers("intrinsics", value, (4, 9), "fx, fy, cx, cy or 3 rows of 3 numbers")
    if len(numbers) == 9:
        return numbers.reshape(3, 3)
    fx, fy, cx, cy = numbers
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _lens(coefficients: Any, model: Any) -> Lens | None:
    """Return the lens; None if no coefficient, or none other than 0, is given."""
    if coefficients is None:
        return None
    if not isinstance(model, str | None):
        raise CalibrationError(f"distortion_model must be a name, got {model!r}")
    numbers = _numbers("distortion", coefficients, range(15), "OpenCV's 4, 5 or 8 coefficients")
    return lens_from_coefficients(model, _as_float32(numbers))


def _pose(name: str, entries: Mapping[str, Any], metres: float) -> Array:
    """Return world_from_cam or color_from_depth (4, 4), metres, whichever the entries give."""
    pose = np.eye(4)
    if "position" in entries:
        from scipy.spatial.transform import Rotation

        quaternion = _numbers("quaternion_xyzw", entries["quaternion_xyzw"], (4,), "four numbers x, y, z, w")
        norm = np.linalg.norm(quaternion)
        if not abs(norm - 1) < ROUNDED:
            raise CalibrationError(f"quaternion_xyzw must have length 1, got {norm:.3g}")
        pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
        pose[:3, 3] = _numbers("position", entries["position"], (3,), "three numbers x, y, z") * metres
        return pose
    key = next(key for key in ("world_from_cam", "cam_from_world", "color_from_depth") if key in entries)
    numbers = _numbers(key, entries[key], (12, 16), "4 (or the first 3) rows of 4 numbers")
    pose[: len(numbers) // 4] = numbers.reshape(-1, 4)
    pose[:3, 3] *= metres
    pose[:3, :3] = _nearest_rotation(f"camera {name!r}: {key}", pose[:3, :3])
    return invert_rigid(pose) if key == "cam_from_world" else pose


def _nearest_rotation(name: str, matrix: Array) -> Array:
    """Return the rotation closest to a rounded one; a matrix that is more than rounded is returned as it is.

    `Camera` rejects the latter.
    """
    if not np.isfinite(matrix).all():
        return matrix
    deviation = np.abs(matrix.T @ matrix - np.eye(3)).max()
    if not 1e-6 < deviation <= ROUNDED or np.linalg.det(matrix) < 0:
        return matrix
    left, _, right = np.linalg.svd(matrix)
    nearest: Array = left @ right
    if deviation > 1e-4:
        change = np.abs(nearest - matrix).max()
        logger.info(
            "%s is not orthonormal (deviation %.2g): the nearest rotation differs by %.2g", name, deviation, change
        )
    return nearest


def _numbers(name: str, value: Any, counts: Container[int], expected: str) -> Array:
    try:
        numbers = np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        numbers = None
    if numbers is None or len(numbers) not in counts:
        raise CalibrationError(f"{name} must be {expected}, got {value!r}")
    return numbers


def _as_float32(matrix: Array) -> Array:
    with np.errstate(over="ignore"):  # Camera rejects infinite values
        return matrix.astype(np.float32).astype(np.float64)


def _unknown_keys(owner: str, entries: Mapping[Any, Any], known: tuple[str, ...]) -> list[str]:
    unknown = [str(key) for key in entries if key not in known]
    return [f"{owner} has unknown keys: {', '.join(unknown)}; expected {', '.join(known)}"] if unknown else []
