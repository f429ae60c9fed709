"""What a calibration file says of a camera, and the numbers in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lerobot_symview.calibration.formats.document import Document
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Array
from lerobot_symview.geometry.lens import lens_from_coefficients

CAMERA_TO_BASE, BASE_TO_CAMERA = "camera_to_base", "base_to_camera"
OPTICAL, ROS_LINK, OPENGL = "optical", "ros_link", "opengl"
Size = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Pose:
    """A rotation and a translation, with what the file says of them; None is what it does not say.

    Args:
        rotation: (3, 3), or a quaternion (4,).
        translation: (3,), in the file's unit.
        direction: camera_to_base or base_to_camera: the frames from which and to which points are mapped.
        axes: of the camera: optical (OpenCV's), ros_link (x forward, z up) or opengl (y up, z backward).
        quaternion_order: xyzw or wxyz; of no meaning for a matrix.
        metres: metres per unit of the translation.
    """

    rotation: Array
    translation: Array
    direction: str | None = None
    axes: str | None = None
    quaternion_order: str | None = None
    metres: float | None = None


@dataclass(frozen=True, eq=False)
class CameraFacts:
    """What a file says of one camera; None is what it does not say.

    Args:
        intrinsics: (3, 3), K in pixels.
        size: rows and columns of the image that K belongs to.
        distortion: coefficients of the lens, in OpenCV's order; empty without distortion.
        distortion_model: plumb_bob, rational_polynomial or equidistant.
        pose: relative to the robot's base or the world.
        depth_unit: metres per unit of depth.
        color_from_depth: (4, 4), metres, of a depth camera beside the colour camera.
        depth_intrinsics: (3, 3), K of that depth camera.
    """

    intrinsics: Array | None = None
    size: Size | None = None
    distortion: tuple[float, ...] = ()
    distortion_model: str | None = None
    pose: Pose | None = None
    depth_unit: float | None = None
    color_from_depth: Array | None = None
    depth_intrinsics: Array | None = None


Facts = dict[str, CameraFacts]
"""Name of a camera -> what the file says of it. A file that does not name its only camera uses the empty name."""


@dataclass(frozen=True)
class Format:
    """A format of calibration files.

    Args:
        title: the tool or the file, for messages.
        recognises: whether a document has this format, by its content.
        parse: returns what the document says; its second argument is the image size that is wanted, if known.
    """

    title: str
    recognises: Callable[[Document], bool]
    parse: Callable[[Document, Size | None], Facts]


def numbers(name: str, value: Any, *shape: int) -> Array:
    """Return finite numbers as float64 of a shape; a list may be flat, nested, or have leading dimensions of 1.

    Raises:
        CalibrationError: if they are no such numbers.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0)
    if array.size != np.prod(shape) or not np.isfinite(array).all():
        expected = " x ".join(map(str, shape)) + " finite numbers" if shape else "a finite number"
        raise CalibrationError(f"{name} must be {expected}, got {str(value)[:80]}")
    return array.reshape(shape)


def number(name: str, value: Any) -> float:
    """Return a finite number."""
    return float(numbers(name, value))


def image_size(height: Any, width: Any) -> Size:
    """Return rows and columns, which must be positive whole numbers of pixels."""
    size = number("image height", height), number("image width", width)
    if min(size) < 1 or any(side != int(side) for side in size):
        raise CalibrationError(f"image height and width must be positive numbers of pixels, got {height!r}, {width!r}")
    return int(size[0]), int(size[1])


def optional_size(entries: Mapping[str, Any], height: str = "height", width: str = "width") -> Size | None:
    """Return the image size of a mapping that may lack it."""
    if entries.get(height) is None or entries.get(width) is None:
        return None
    return image_size(entries[height], entries[width])


def pinhole(fx: Any, fy: Any, cx: Any, cy: Any) -> Array:
    """Return K (3, 3)."""
    fx, fy, cx, cy = numbers("fx, fy, cx, cy", [fx, fy, cx, cy], 4)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def intrinsics_matrix(name: str, value: Any) -> Array:
    """Return K (3, 3) of a camera that was calibrated."""
    matrix = numbers(name, value, 3, 3)
    if not matrix[:2].any():
        raise CalibrationError(f"{name} is all zero: the camera was never calibrated; calibrate it first")
    return matrix


def lens(model: str | None, coefficients: ArrayLike) -> dict[str, Any]:
    """Return the facts of a lens; of none if all its coefficients are zero. Trailing zeros count as absent.

    Raises:
        CalibrationError: if the model is unknown or has another number of coefficients.
    """
    found = lens_from_coefficients(model, coefficients)
    return {} if found is None else {"distortion": found.coefficients, "distortion_model": found.model}


def matrix_pose(
    name: str, value: Any, direction: str | None = None, axes: str | None = None, metres: float | None = None
) -> Pose:
    """Return the pose in a 4 x 4 matrix, or in its first three rows."""
    matrix = numbers(name, value, 3 if count(value) == 12 else 4, 4)
    if len(matrix) == 4 and not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise CalibrationError(f"the last row of {name} must be 0 0 0 1, got {matrix[3]}")
    return Pose(matrix[:3, :3], matrix[:3, 3], direction, axes, None, metres)


def pose_between(parent: str, child: str, rotation: Array, translation: Array) -> Pose:
    """Return the pose in which parent_from_child is given with ROS's frame names, quaternion x, y, z, w, in metres.

    The frame whose name has `cam` or `optical` is the camera's.
    """
    cameras = [_names_camera(parent), _names_camera(child)]
    direction = {(False, True): CAMERA_TO_BASE, (True, False): BASE_TO_CAMERA}.get((cameras[0], cameras[1]))
    frame = parent if direction == BASE_TO_CAMERA else child
    return Pose(rotation, translation, direction, frame_axes(frame), "xyzw", 1.0)


def frame_axes(frame: str) -> str | None:
    """Return the axes that the name of a ROS frame says: `..._optical_frame` or `..._link`; None for other names."""
    if "optical" in frame:
        return OPTICAL
    return ROS_LINK if frame.endswith("_link") else None


def _names_camera(frame: str) -> bool:
    return "cam" in frame.lower() or "optical" in frame


def count(value: Any) -> int:
    """Return how many numbers a list, flat or nested, has; 0 if it is none."""
    try:
        return np.array(value, dtype=np.float64).size
    except (TypeError, ValueError, OverflowError):
        return 0


def choose_size(blocks: Mapping[Size, Any], wanted: Size | None) -> tuple[Size, Any]:
    """Return the block of the wanted image size, or the only one.

    Raises:
        CalibrationError: if it is not among several blocks; the message lists their sizes.
    """
    if wanted is not None and wanted in blocks:
        return wanted, blocks[wanted]
    if len(blocks) == 1:
        return next(iter(blocks.items()))
    sizes = ", ".join(f"{width} x {height}" for height, width in blocks)
    asked = f"none is {wanted[1]} x {wanted[0]}" if wanted else "the image size must be known"
    raise CalibrationError(f"it has intrinsics for images of {sizes}: {asked}")
