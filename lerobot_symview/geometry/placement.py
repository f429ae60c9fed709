"""Camera placement, by angles around the workspace or by matrices, and the calibrated camera that results."""

from __future__ import annotations

from dataclasses import asdict, astuple, dataclass, field, replace
from typing import Any

import numpy as np

from lerobot_symview.errors import CalibrationError, OptionError
from lerobot_symview.geometry.camera import Array, Camera, intrinsics_from_fov, orbit_pose
from lerobot_symview.geometry.lens import Lens, lens_from_coefficients
from lerobot_symview.geometry.miscalibration import Miscalibration
from lerobot_symview.geometry.visibility import MINIMUM_VISIBLE, check_camera
from lerobot_symview.geometry.workspace import Workspace

TOP_DISTANCE = 8.0  # metres: at this distance perspective shifts the top of a 5 cm block by less than a millimetre
TRIES = 100
MAX_DELAY = 100  # actions, whose images are kept
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class CameraSpread:
    """Largest deviation of a camera's pose from its nominal pose; sampled uniformly for every episode.

    Raises:
        OptionError: if a deviation is negative or not finite.
    """

    elevation_deg: float = 0.0
    """Degrees; the sampled elevation stays within 1 to 90 degrees above the table."""
    azimuth_deg: float = 0.0
    """Degrees; 180 samples all directions around the table."""
    distance: float = 0.0
    """Metres."""
    target: float = 0.0
    """Metres, along each axis of the look-at point."""

    def __post_init__(self) -> None:
        if not all(0 <= deviation < np.inf for deviation in astuple(self)):
            raise OptionError(f"a camera's spread must be finite and not negative, got {self}")


@dataclass(frozen=True)
class CameraSpec:
    """A camera over the workspace, and the errors of its depth, its timing and its calibration.

    Raises:
        OptionError: if values are invalid; the message lists them all.
    """

    name: str = "side"
    """Name of the camera in feature keys, such as `side`."""
    height: int = 152
    """Rows, pixels."""
    width: int = 152
    """Columns, pixels."""
    fov_deg: float = 48.0
    """Vertical field of view, degrees."""
    elevation_deg: float = 45.0
    """Elevation above the table, degrees."""
    azimuth_deg: float = 0.0
    """Azimuth about the vertical, degrees; 0 faces the robot."""
    distance: float = 0.81
    """Distance from the look-at point, metres."""
    target: Vector = (0.0, 0.0, 0.0)
    """Look-at point, metres, relative to the centre of the workspace on the table."""
    spread: CameraSpread = field(default_factory=CameraSpread)
    """Largest random deviation of the pose in each episode."""
    intrinsics: tuple[float, ...] | None = None
    """K in pixels, 9 numbers, row-major; replaces fov_deg."""
    world_from_cam: tuple[float, ...] | None = None
    """Pose, 16 numbers, row-major, metres, OpenCV axes; replaces the angles, distance and target."""
    distortion: tuple[float, ...] = ()
    """Coefficients of its lens, 4, 5 or 8 in OpenCV's order, such as `[-0.3, 0.1, 0, 0]`; by default it has no lens."""
    distortion_model: str | None = None
    """`plumb_bob`, `rational_polynomial` or `equidistant` (fisheye); by default it follows from the number of
    coefficients."""
    distortion_known: bool = True
    """Whether the calibration that observations state has the lens."""
    sees_robot: bool = True
    """Whether the arm is rendered; False gives an oracle camera."""
    depth_noise: float = 0.0
    """Standard deviation of depth at 1 m, metres; grows with the square of the depth, as for a stereo camera."""
    depth_dropout: float = 0.0
    """Fraction of pixels without depth. It is ten times as large beside depth discontinuities, where one of a stereo
    camera's two sensors is occluded."""
    flying_pixels: float = 0.0
    """Fraction of the pixels beside depth discontinuities that measure a depth between the two surfaces."""
    delay: int = 0
    """Actions by which images are late; the state is not."""
    miscalibration: Miscalibration = field(default_factory=Miscalibration)
    """Error of the calibration that observations state."""

    def __post_init__(self) -> None:
        problems = []
        if not self.name.isidentifier():
            problems.append("name must be an identifier")
        if not np.isfinite([self.azimuth_deg, *self.target]).all():
            problems.append(f"azimuth_deg and target must be finite, got {self.azimuth_deg:g} and {self.target}")
        if min(self.height, self.width) < 8:
            problems.append(f"height and width must be at least 8 pixels, got {self.height} x {self.width}")
        if not 0 < self.fov_deg < 180:
            problems.append(f"fov_deg must lie in (0, 180) degrees, got {self.fov_deg:g}")
        if not 0 < self.elevation_deg <= 90:
            problems.append(f"elevation_deg must lie in (0, 90] degrees, got {self.elevation_deg:g}")
        if self.intrinsics is not None and len(self.intrinsics) != 9:
            problems.append(f"intrinsics must be 9 numbers, got {len(self.intrinsics)}")
        if self.world_from_cam is not None and len(self.world_from_cam) != 16:
            problems.append(f"world_from_cam must be 16 numbers, got {len(self.world_from_cam)}")
        if self.world_from_cam is not None and self.varies:
            problems.append("spread needs a pose by angles, not world_from_cam")
        if not 0 < self.distance < np.inf:
            problems.append(f"distance must be positive metres, got {self.distance:g}")
        elif self.spread.distance >= self.distance:
            problems.append(f"spread.distance must be smaller than distance, got {self.spread.distance:g}")
        if not 0 <= self.depth_noise < np.inf:
            problems.append(f"depth_noise must not be negative, got {self.depth_noise:g}")
        if not 0 <= self.depth_dropout <= 1:
            problems.append(f"depth_dropout must lie in [0, 1], got {self.depth_dropout:g}")
        if not 0 <= self.flying_pixels <= 1:
            problems.append(f"flying_pixels must lie in [0, 1], got {self.flying_pixels:g}")
        if not 0 <= self.delay <= MAX_DELAY:
            problems.append(f"delay must be 0 to {MAX_DELAY} actions, got {self.delay}")
        try:
            if self.lens is None and self.distortion_model is not None:
                problems.append(f"distortion_model={self.distortion_model} needs distortion, got {self.distortion}")
        except CalibrationError as error:
            problems.append(f"distortion: {error}")
        if problems:
            raise OptionError(f"camera {self.name!r}: {'; '.join(problems)}")

    @property
    def lens(self) -> Lens | None:
        """The lens; None for a pinhole camera."""
        return lens_from_coefficients(self.distortion_model, self.distortion)

    @property
    def states_lens(self) -> bool:
        """Whether the calibration that observations state has a lens."""
        return self.distortion_known and self.lens is not None

    @property
    def varies(self) -> bool:
        """Whether the pose is sampled for every episode."""
        return max(astuple(self.spread)) > 0

    def place(
        self, workspace: Workspace, rng: np.random.Generator | None = None, minimum_visible: float = MINIMUM_VISIBLE
    ) -> Camera:
        """Return the calibrated camera over `workspace`.

        Args:
            workspace: the working volume that must be in the image.
            rng: samples a pose within the spread; without it, or without a spread, the nominal pose is used.
            minimum_visible: fraction of the working volume that must be in the image.

        Raises:
            CalibrationError: if less than `minimum_visible` of the working volume is in the image, for each of 100
                sampled poses, or if the matrices are invalid.
        """
        camera = self._camera(workspace, rng)
        for _ in range(TRIES if rng is not None and self.varies else 0):
            if workspace.visible_fraction(camera) >= minimum_visible:
                break
            camera = self._camera(workspace, rng)
        angles = "raise its distance or fov_deg, point it at the workspace, or lower its spread"
        remedy = angles if self.world_from_cam is None else ""
        check_camera(self.name, camera, workspace, remedy, minimum_visible, pixels=0.0)
        return camera

    def _camera(self, workspace: Workspace, rng: np.random.Generator | None) -> Camera:
        spec = self if rng is None or not self.varies else self._sampled(rng)
        return Camera(spec._intrinsics(), spec._pose(workspace), self.height, self.width, self.lens)

    def _sampled(self, rng: np.random.Generator) -> CameraSpec:
        spread = self.spread
        lowest = max(self.elevation_deg - spread.elevation_deg, min(1.0, self.elevation_deg))
        return replace(
            self,
            elevation_deg=rng.uniform(lowest, min(self.elevation_deg + spread.elevation_deg, 90.0)),
            azimuth_deg=self.azimuth_deg + rng.uniform(-spread.azimuth_deg, spread.azimuth_deg),
            distance=self.distance + rng.uniform(-spread.distance, spread.distance),
            target=tuple(np.asarray(self.target) + rng.uniform(-spread.target, spread.target, size=3)),
        )

    def _intrinsics(self) -> Array:
        if self.intrinsics is not None:
            return np.reshape(np.asarray(self.intrinsics, dtype=np.float64), (3, 3))
        return intrinsics_from_fov(np.deg2rad(self.fov_deg), self.height, self.width)

    def _pose(self, workspace: Workspace) -> Array:
        if self.world_from_cam is not None:
            return np.reshape(np.asarray(self.world_from_cam, dtype=np.float64), (4, 4))
        target = np.array([*workspace.center, 0.0]) + self.target
        return orbit_pose(np.deg2rad(self.elevation_deg), np.deg2rad(self.azimuth_deg), self.distance, target)


PINHOLE = {"distortion": (), "distortion_model": None, "distortion_known": True}
"""The settings of a lens, as they are without one."""


def described(spec: CameraSpec) -> dict[str, Any]:
    """Return the settings of a camera, without those of a lens if it has none.

    Recordings and results that are older than these settings remain valid.
    """
    return {name: value for name, value in asdict(spec).items() if spec.distortion or name not in PINHOLE}


def top_camera(size: int, workspace: Workspace) -> CameraSpec:
    """Return the top-down oracle camera: `size` x `size` pixels that show exactly the workspace, without the arm."""
    fov_deg = 2 * np.rad2deg(np.arctan(workspace.size / 2 / TOP_DISTANCE))
    return CameraSpec("top", size, size, fov_deg=fov_deg, elevation_deg=90.0, distance=TOP_DISTANCE, sees_robot=False)
