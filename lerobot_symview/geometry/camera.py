"""Cameras: intrinsics, lenses, poses, projection and its inverse.

A lens maps pixels to *ideal* pixels, at which a pinhole camera with the same K would show the same rays; behind them
all geometry is that of the pinhole camera.

Axes are OpenCV's (x right, y down, z forward), integer pixel coordinates are pixel centres, lengths are metres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.calibration_problems import calibration_problems, lens_problems
from lerobot_symview.geometry.lens import Lens, stored_lens

Array = NDArray[np.float64]

Optics = tuple[Lens | None, float, float, float, float, int, int]

LONGEST_BASELINE = 0.5  # between colour and depth, metres: sensors have 0.01 to 0.1


@dataclass(frozen=True, eq=False)
class DepthSensor:
    """The depth camera of a colour camera whose depth images are not aligned with colour.

    Args:
        intrinsics: (3, 3) float64, its matrix K in pixels of the depth image, no skew, no lens.
        color_from_depth: (4, 4) float64, rigid, maps its coordinates to those of the colour camera, metres.

    Raises:
        CalibrationError: if a matrix is invalid; one message lists all problems.
    """

    intrinsics: Array
    color_from_depth: Array

    def __post_init__(self) -> None:
        for name in ("intrinsics", "color_from_depth"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        problems = calibration_problems(self.intrinsics, self.color_from_depth, None, "color_from_depth")
        if not problems and (baseline := np.linalg.norm(self.color_from_depth[:3, 3])) > LONGEST_BASELINE:
            problems = [f"color_from_depth has a translation of {baseline:g} m: is it in millimetres?"]
        if problems:
            raise CalibrationError("invalid depth sensor: " + "; ".join(problems))


@lru_cache(maxsize=64)
def _sensor_camera(sensor: DepthSensor, color: Camera, height: int, width: int) -> Camera:
    try:
        return Camera(sensor.intrinsics, color.world_from_cam @ sensor.color_from_depth, height, width)
    except CalibrationError as error:
        raise CalibrationError(f"the depth sensor does not fit its images: {error}") from None


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera.

    Args:
        intrinsics: (3, 3) float64, the matrix K in pixels, no skew.
        world_from_cam: (4, 4) float64, rigid, maps camera coordinates to world coordinates, metres.
        height: image rows.
        width: image columns.
        lens: its distortion; None, or a lens that distorts nothing, for a pinhole camera.
        depth_sensor: the camera of its depth images; None where these are aligned with colour.

    Raises:
        CalibrationError: if the matrices are invalid, or the lens does not show one ray in each pixel; one message
            lists all problems.
    """

    intrinsics: Array
    world_from_cam: Array
    height: int
    width: int
    lens: Lens | None = None
    depth_sensor: DepthSensor | None = None

    def __post_init__(self) -> None:
        intrinsics = np.asarray(self.intrinsics, dtype=np.float64)
        world_from_cam = np.asarray(self.world_from_cam, dtype=np.float64)
        lens = None if self.lens is None or self.lens.is_pinhole else self.lens
        problems = calibration_problems(intrinsics, world_from_cam, (self.height, self.width))
        if lens is not None and not problems:
            (fx, _, cx), (_, fy, cy), _ = intrinsics.tolist()
            problems = lens_problems(lens, fx, fy, cx, cy, self.height, self.width)
        if problems:
            raise CalibrationError("invalid camera: " + "; ".join(problems))
        object.__setattr__(self, "intrinsics", intrinsics)
        object.__setattr__(self, "world_from_cam", world_from_cam)
        object.__setattr__(self, "lens", lens)

    @property
    def fx(self) -> float:
        """Focal length along u, pixels."""
        return float(self.intrinsics[0, 0])

    @property
    def fy(self) -> float:
        """Focal length along v, pixels."""
        return float(self.intrinsics[1, 1])

    @property
    def cx(self) -> float:
        """Principal point, u, pixels."""
        return float(self.intrinsics[0, 2])

    @property
    def cy(self) -> float:
        """Principal point, v, pixels."""
        return float(self.intrinsics[1, 2])

    @property
    def position(self) -> Array:
        """(3,) optical centre in the world frame, metres."""
        return self.world_from_cam[:3, 3]

    @property
    def cam_from_world(self) -> Array:
        """(4, 4) inverse of `world_from_cam`."""
        return invert_rigid(self.world_from_cam)

    @property
    def optics(self) -> Optics:
        """What the ideal pixels of its image depend on: lens, fx, fy, cx, cy, height and width."""
        return self.lens, self.fx, self.fy, self.cx, self.cy, self.height, self.width

    def depth_camera(self, height: int, width: int) -> Camera:
        """Return the camera of its depth images of a size: that of its depth sensor, or itself if it has none.

        Raises:
            CalibrationError: if the depth sensor does not fit the size.
        """
        return self if self.depth_sensor is None else _sensor_camera(self.depth_sensor, self, height, width)

    def resized(self, height: int, width: int | None = None) -> Camera:
        """Return the camera of the image after a change of its size; the field of view is the same.

        Args:
            height: image rows.
            width: image columns; by default in proportion to the rows.
        """
        width = round(height / self.height * self.width) if width is None else width
        scale = np.array([width / self.width, height / self.height])
        intrinsics = self.intrinsics.copy()
        intrinsics[:2] *= scale[:, None]
        intrinsics[:2, 2] += (scale - 1) / 2  # integer coordinates are pixel centres
        return Camera(intrinsics, self.world_from_cam, height, width, self.lens, self.depth_sensor)


def stored_camera(
    intrinsics: NDArray,
    world_from_cam: NDArray,
    height: int,
    width: int,
    distortion: NDArray | None = None,
    depth_intrinsics: NDArray | None = None,
    color_from_depth: NDArray | None = None,
) -> Camera:
    """Return the camera with the matrices stored in a dataset or an observation.

    Args:
        intrinsics: (9,) or (3, 3), K in pixels.
        world_from_cam: (16,) or (4, 4), metres.
        height: image rows.
        width: image columns.
        distortion: (9,), as `Lens.stored` returns; None for a pinhole camera.
        depth_intrinsics: (9,) or (3, 3), K of the depth sensor; None where depth is aligned with colour.
        color_from_depth: (16,) or (4, 4), its place, metres; None where depth is aligned with colour.

    Returns:
        The same object for equal arguments, so that results that depend on the camera alone can be cached.

    Raises:
        CalibrationError: if the matrices or the lens are invalid, as for `Camera`, or one of a depth sensor is missing.
    """
    if (depth_intrinsics is None) != (color_from_depth is None):
        raise CalibrationError("depth_intrinsics and color_from_depth belong together: one is missing")
    matrices = [intrinsics, world_from_cam]
    if depth_intrinsics is not None and color_from_depth is not None:
        matrices += [depth_intrinsics, color_from_depth]
    numbers = (np.asarray(matrix, dtype=np.float64).tobytes() for matrix in matrices)
    return _camera(height, width, None if distortion is None else stored_lens(distortion), *numbers)


@lru_cache(maxsize=256)
def _camera(
    height: int,
    width: int,
    lens: Lens | None,
    intrinsics: bytes,
    world_from_cam: bytes,
    depth_intrinsics: bytes | None = None,
    color_from_depth: bytes | None = None,
) -> Camera:
    sensor = None
    if depth_intrinsics is not None and color_from_depth is not None:
        sensor = DepthSensor(_matrix(depth_intrinsics, 3), _matrix(color_from_depth, 4))
    return Camera(_matrix(intrinsics, 3), _matrix(world_from_cam, 4), height, width, lens, sensor)


def _matrix(numbers: bytes, side: int) -> Array:
    return np.frombuffer(numbers).reshape(side, side)


def intrinsics_from_fov(fov: float, height: int, width: int) -> Array:
    """Return K (3, 3) of a centred pinhole camera with a vertical field of view of `fov` radians.

    The image spans pixel edges -0.5 to height - 0.5, so the principal point is ((width - 1)/2, (height - 1)/2).
    """
    if not 0 < fov < np.pi:
        raise CalibrationError(f"field of view must lie in (0, pi) radians, got {fov:g}")
    focal = height / 2 / np.tan(fov / 2)
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])


def orbit_pose(elevation: float, azimuth: float, distance: float, target: ArrayLike) -> Array:
    """Return world_from_cam (4, 4) of a camera on a sphere around `target` that looks at it, without roll.

    Args:
        elevation: radians above the horizontal plane; pi/2 looks straight down.
        azimuth: radians about world z; 0 is on the +x side of the target, pi/2 on the +y side.
        distance: metres, positive.
        target: (3,) world point, metres.

    The axes are computed in closed form rather than from an up vector, so looking straight down is not a special case:
    at elevation pi/2 and azimuth 0, rows grow with +x and columns with +y.
    """
    if distance <= 0:
        raise CalibrationError(f"camera distance must be positive, got {distance:g} m")
    (se, ce), (sa, ca) = (np.sin(elevation), np.cos(elevation)), (np.sin(azimuth), np.cos(azimuth))
    backward = np.array([ce * ca, ce * sa, se])
    right = np.array([-sa, ca, 0.0])
    world_from_cam = np.eye(4)
    world_from_cam[:3, 0] = right
    world_from_cam[:3, 1] = np.cross(-backward, right)
    world_from_cam[:3, 2] = -backward
    world_from_cam[:3, 3] = np.asarray(target, dtype=np.float64) + distance * backward
    return world_from_cam


def invert_rigid(a_from_b: Array) -> Array:
    """Return b_from_a (4, 4) float64 for a rigid a_from_b (4, 4), metres: R^T and -R^T t, exact up to rounding."""
    b_from_a = np.eye(4)
    b_from_a[:3, :3] = a_from_b[:3, :3].T
    b_from_a[:3, 3] = -a_from_b[:3, :3].T @ a_from_b[:3, 3]
    return b_from_a


def transform(a_from_b: Array, points_b: Array) -> Array:
    """Map points (..., 3) from frame b to frame a with a rigid (4, 4): R p + t; float64, both in metres."""
    return points_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def aligned_depth(depth: NDArray[np.floating], camera: Camera) -> NDArray[np.floating]:
    """Return depth in the pixels of the colour camera: registered if it is of a sensor of its own, else unchanged.

    Args:
        depth: (h, w) float, metres along the optical axis of the sensor, or of the camera where it has no sensor.
        camera: the colour camera.

    Raises:
        CalibrationError: if the depth sensor does not fit the image.
    """
    if camera.depth_sensor is None:
        return depth
    from lerobot_symview.geometry.registration import register_depth  # slow import: numba

    return register_depth(depth, camera)


def unproject(depth: NDArray[np.floating], camera: Camera) -> Array:
    """Unproject a depth image to world points (paper Eq. 2-4).

    Args:
        depth: (H, W) float, finite, metres along the optical axis.
        camera: its calibration.

    Returns:
        (H, W, 3) float64, world coordinates in metres.

    Raises:
        ValueError: if the depth image and the camera differ in size.
    """
    if depth.shape != (camera.height, camera.width):
        raise ValueError(f"depth has shape {depth.shape}, the camera is {(camera.height, camera.width)}")
    u, v = ideal_pixels(camera.optics)
    x_over_z, y_over_z = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    z = depth.astype(np.float64)
    points_cam = np.stack([z * x_over_z, z * y_over_z, z], axis=-1)
    return transform(camera.world_from_cam, points_cam)


def project(points_world: Array, camera: Camera) -> tuple[Array, Array]:
    """Project world points to pixels: y = K (R x + t), divided by its last entry (paper section 4.2), and the lens.

    Args:
        points_world: (..., 3), metres.
        camera: its calibration.

    Returns:
        (..., 2) float64 pixels (u, v), integers at pixel centres, and (...) float64 depth along the optical axis,
        metres. Points with depth <= 0 lie behind the camera; their pixels are not meaningful, and not finite at 0.
    """
    points_cam = transform(camera.cam_from_world, np.asarray(points_world, dtype=np.float64))
    depth = points_cam[..., 2]
    homogeneous = points_cam @ camera.intrinsics.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return from_ideal(homogeneous[..., :2] / depth[..., None], camera), depth


def ideal_pixels(optics: Optics) -> tuple[Array, Array]:
    """Return the ideal pixels of all pixels of an image: u and v, float64, that broadcast to (H, W).

    Without a lens they are the pixels themselves, (W,) and (H, 1). With a lens they are read-only (H, W) maps, exact to
    1e-6 pixels, which are cached for recent optics: the camera may move.

    Args:
        optics: of the camera, `Camera.optics`.
    """
    lens, *_, height, width = optics
    if lens is None:
        return np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)[:, None]
    return _ideal_maps(*optics)


@lru_cache(maxsize=8)  # 5 MB each for images of 640 x 480
def _ideal_maps(lens: Lens, fx: float, fy: float, cx: float, cy: float, height: int, width: int) -> tuple[Array, Array]:
    y, x = np.meshgrid((np.arange(height) - cy) / fy, (np.arange(width) - cx) / fx, indexing="ij")
    u, v = np.moveaxis(lens.undistort(np.stack([x, y], axis=-1)) * [fx, fy] + [cx, cy], -1, 0).copy()
    u.flags.writeable = v.flags.writeable = False
    return u, v


def to_ideal(pixels: Array, camera: Camera) -> Array:
    """Map pixels (..., 2) of a camera's image to ideal pixels (..., 2); NaN where its lens shows no ray."""
    return pixels if camera.lens is None else _through(camera.lens.undistort, pixels, camera)


def from_ideal(pixels: Array, camera: Camera) -> Array:
    """Map ideal pixels (..., 2) to pixels (..., 2) of a camera's image; inverse of `to_ideal`."""
    return pixels if camera.lens is None else _through(camera.lens.distort, pixels, camera)


def _through(mapping: Callable[[Array], Array], pixels: Array, camera: Camera) -> Array:
    center, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    return mapping((pixels - center) / focal) * focal + center
