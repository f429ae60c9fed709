"""Rerun recording of frames: camera frusta, point clouds, the workspace and the views (extra `viz`).

Rerun knows pinhole cameras alone: images of a camera with a lens are shown undistorted.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import unproject
from lerobot_symview.geometry.undistortion import undistorted
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import CommandError
from lerobot_symview.views import Frame

FRUSTUM = 0.1  # metres from the camera to its drawn image plane
POINT_RADIUS = 0.002  # metres


class RerunRecording:
    """Writes frames to a file that `rerun FILE` opens.

    Args:
        file: path of the file, ending in `.rrd`.
        workspace: the workspace, whose outline is drawn on the table and at its height limit.

    Raises:
        CommandError: if rerun is not installed.
    """

    def __init__(self, file: Path, workspace: Workspace):
        try:
            import rerun
        except ImportError:
            raise CommandError(
                "--rerun=true needs rerun, which is not installed: "
                "run `pip install 'lerobot_policy_symview[viz]'` or pass --rerun=false"
            ) from None
        self._rerun: Any = rerun
        self._stream: Any = rerun.RecordingStream("symview-preview")
        self._stream.save(file)
        self._stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        borders = [
            np.vstack([corners, corners[:1]]) for corners in map(workspace.corners, (0.0, workspace.height_limit))
        ]
        self._stream.log("world/workspace", rerun.LineStrips3D(borders), static=True)

    def add(self, index: int, camera: str, frame: Frame, images: dict[str, NDArray]) -> None:
        """Add one frame.

        Args:
            index: position of the frame in the recording's timeline.
            camera: name of the camera.
            frame: image, depth and pose of the camera.
            images: views of the frame by name: colour (H, W, 3) uint8, or height (H, W) in metres.
        """
        rerun, log = self._rerun, self._stream.log
        self._stream.set_time("frame", sequence=index)
        pose = frame.camera.world_from_cam
        log(f"world/{camera}", rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        pinhole = rerun.Pinhole(
            image_from_camera=frame.camera.intrinsics,
            resolution=[frame.camera.width, frame.camera.height],
            image_plane_distance=FRUSTUM,
        )
        log(f"world/{camera}/image", pinhole, rerun.Image(undistorted(frame.rgb, frame.camera)))
        if frame.depth is not None:
            depth = frame.depth
            seen = np.isfinite(depth) & (depth > 0)
            points = unproject(np.where(seen, depth, 0.0), frame.camera)[seen]
            log("world/points", rerun.Points3D(points, colors=frame.rgb[seen], radii=POINT_RADIUS))
        for name, image in images.items():
            log(f"views/{name}", rerun.Image(image) if image.ndim == 3 else rerun.DepthImage(image, meter=1.0))

    def close(self) -> None:
        """Finish and close the file."""
        self._stream.disconnect()
