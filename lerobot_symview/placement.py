"""Where a camera stands: named by angles around the workspace, turned into a calibrated camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lerobot_symview.camera import Camera, intrinsics_from_fov, orbit_pose
from lerobot_symview.workspace import Workspace

TOP_DISTANCE = 8.0  # metres: from so far above, perspective shifts a 5 cm block's top by less than a millimetre


@dataclass(frozen=True)
class CameraSpec:
    """A camera that looks at the centre of the workspace."""

    name: str = "side"
    """Prefix of its keys, such as `side`."""
    size: int = 152
    """Rows and columns, pixels."""
    fov_deg: float = 48.0
    """Vertical field of view, degrees."""
    elevation_deg: float = 45.0
    """Degrees above the table."""
    azimuth_deg: float = 0.0
    """Degrees about the vertical; 0 faces the robot."""
    distance: float = 0.81
    """Metres from the centre of the workspace."""
    sees_robot: bool = True
    """Whether the arm is drawn; False gives an oracle."""

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"camera name must be an identifier, got {self.name!r}")
        if self.size < 8:
            raise ValueError(f"camera {self.name!r}: size must be at least 8 pixels, got {self.size}")
        if not 0 < self.elevation_deg <= 90:
            raise ValueError(
                f"camera {self.name!r}: elevation_deg must lie in (0, 90] degrees, got {self.elevation_deg:g}"
            )

    def place(self, workspace: Workspace, minimum_visible: float = 0.6) -> Camera:
        """Return the calibrated camera over `workspace`.

        Raises:
            ValueError: if it sees less than `minimum_visible` of the working volume.
        """
        camera = Camera(
            intrinsics=intrinsics_from_fov(np.deg2rad(self.fov_deg), self.size, self.size),
            world_from_cam=orbit_pose(
                np.deg2rad(self.elevation_deg), np.deg2rad(self.azimuth_deg), self.distance, (*workspace.center, 0.0)
            ),
            height=self.size,
            width=self.size,
        )
        visible = workspace.visible_fraction(camera)
        if visible < minimum_visible:
            raise ValueError(
                f"camera {self.name!r} sees {visible:.0%} of the workspace, expected at least {minimum_visible:.0%}: "
                "raise its distance or fov_deg"
            )
        return camera


def top_camera(size: int, workspace: Workspace) -> CameraSpec:
    """Oracle: from straight above, framing the table's square exactly, arm not drawn."""
    fov_deg = 2 * np.rad2deg(np.arctan(workspace.size / 2 / TOP_DISTANCE))
    return CameraSpec("top", size, fov_deg=fov_deg, elevation_deg=90.0, distance=TOP_DISTANCE, sees_robot=False)
