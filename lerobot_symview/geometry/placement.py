"""Where a camera stands: named by angles around the workspace or by matrices, turned into a calibrated camera."""

from __future__ import annotations

from dataclasses import astuple, dataclass, field, replace

import numpy as np

from lerobot_symview.geometry.camera import Array, Camera, intrinsics_from_fov, orbit_pose
from lerobot_symview.geometry.workspace import MINIMUM_VISIBLE, Workspace, check_visible

TOP_DISTANCE = 8.0  # metres: from so far above, perspective shifts a 5 cm block's top by less than a millimetre
TRIES = 100
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class CameraSpread:
    """How far a camera's pose may be, at most, from the stated one; drawn anew and uniformly for every episode."""

    elevation_deg: float = 0.0
    """Degrees, within 1 to 90 degrees above the table."""
    azimuth_deg: float = 0.0
    """Degrees; 180 draws from everywhere around the table."""
    distance: float = 0.0
    """Metres."""
    target: float = 0.0
    """Metres, along each axis of the point looked at."""

    def __post_init__(self) -> None:
        if min(astuple(self)) < 0:
            raise ValueError(f"a camera's spread must not be negative, got {self}")


@dataclass(frozen=True)
class CameraSpec:
    """A pinhole camera over the workspace, and the flaws of its depth sensor."""

    name: str = "side"
    """Prefix of its keys, such as `side`."""
    height: int = 152
    """Rows, pixels."""
    width: int = 152
    """Columns, pixels."""
    fov_deg: float = 48.0
    """Vertical field of view, degrees."""
    elevation_deg: float = 45.0
    """Degrees above the table."""
    azimuth_deg: float = 0.0
    """Degrees about the vertical; 0 faces the robot."""
    distance: float = 0.81
    """Metres from the point looked at."""
    target: Vector = (0.0, 0.0, 0.0)
    """Point looked at, metres from the centre of the workspace on the table."""
    spread: CameraSpread = field(default_factory=CameraSpread)
    """How far the pose may differ from episode to episode."""
    intrinsics: tuple[float, ...] | None = None
    """K in pixels, 9 numbers row by row, in place of fov_deg."""
    world_from_cam: tuple[float, ...] | None = None
    """Pose in metres, 16 numbers row by row, OpenCV axes, in place of the angles, distance and target."""
    sees_robot: bool = True
    """Whether the arm is drawn; False gives an oracle."""
    depth_noise: float = 0.0
    """Standard deviation of depth at 1 m, metres; grows with the square of the depth as a stereo camera's does."""
    depth_dropout: float = 0.0
    """Share of the pixels without depth. Beside a jump of depth, which one of a stereo camera's eyes does not see past,
    it is ten times as large."""

    def __post_init__(self) -> None:
        problems = []
        if not self.name.isidentifier():
            problems.append("name must be an identifier")
        if min(self.height, self.width) < 8:
            problems.append(f"height and width must be at least 8 pixels, got {self.height} x {self.width}")
        if not 0 < self.elevation_deg <= 90:
            problems.append(f"elevation_deg must lie in (0, 90] degrees, got {self.elevation_deg:g}")
        if self.intrinsics is not None and len(self.intrinsics) != 9:
            problems.append(f"intrinsics must be 9 numbers, got {len(self.intrinsics)}")
        if self.world_from_cam is not None and len(self.world_from_cam) != 16:
            problems.append(f"world_from_cam must be 16 numbers, got {len(self.world_from_cam)}")
        if self.world_from_cam is not None and self.varies:
            problems.append("spread needs a pose by angles, not world_from_cam")
        if self.spread.distance >= self.distance:
            problems.append(f"spread.distance must be smaller than distance, got {self.spread.distance:g}")
        if self.depth_noise < 0 or not 0 <= self.depth_dropout <= 1:
            problems.append("depth_noise must not be negative and depth_dropout must lie in [0, 1]")
        if problems:
            raise ValueError(f"camera {self.name!r}: {'; '.join(problems)}")

    @property
    def varies(self) -> bool:
        """Whether every episode sees from another place."""
        return max(astuple(self.spread)) > 0

    def place(
        self, workspace: Workspace, rng: np.random.Generator | None = None, minimum_visible: float = MINIMUM_VISIBLE
    ) -> Camera:
        """Return the calibrated camera over `workspace`.

        Args:
            workspace: what it has to see.
            rng: draws a pose within the spread; without it, or without a spread, the pose is the stated one.
            minimum_visible: share of the working volume that has to be in the image.

        Raises:
            CalibrationError: if it sees less than `minimum_visible` (none of 100 drawn poses sees as much), or the
                matrices are not a camera's.
        """
        camera = self._camera(workspace, rng)
        for _ in range(TRIES if rng is not None and self.varies else 0):
            if workspace.visible_fraction(camera) >= minimum_visible:
                break
            camera = self._camera(workspace, rng)
        remedy = "raise its distance or fov_deg, turn it towards the workspace, or lower its spread"
        check_visible(self.name, camera, workspace, remedy, minimum_visible)
        return camera

    def _camera(self, workspace: Workspace, rng: np.random.Generator | None) -> Camera:
        spec = self if rng is None or not self.varies else self._drawn(rng)
        return Camera(spec._intrinsics(), spec._pose(workspace), self.height, self.width)

    def _drawn(self, rng: np.random.Generator) -> CameraSpec:
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


def top_camera(size: int, workspace: Workspace) -> CameraSpec:
    """Oracle of `size` x `size` pixels: from straight above, framing the table's square exactly, arm not drawn."""
    fov_deg = 2 * np.rad2deg(np.arctan(workspace.size / 2 / TOP_DISTANCE))
    return CameraSpec("top", size, size, fov_deg=fov_deg, elevation_deg=90.0, distance=TOP_DISTANCE, sees_robot=False)
