"""The view `persp`: RGB warped by the homography of a plane parallel to the table (paper section 4.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.homography import inside_image, pixel_density, warp_map, warp_plane
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views.base import (
    NO_CAMERAS,
    CameraNames,
    Frame,
    Kind,
    View,
    check_size,
    checked_cameras,
    gray_to_rgb,
)


def warp_table(
    rgb: NDArray[np.uint8] | Sequence[NDArray[np.uint8]],
    camera: Camera | Sequence[Camera],
    workspace: Workspace,
    size: int = 152,
    plane_height: float = 0.0,
) -> NDArray[np.uint8]:
    """Warp an RGB image to a top-down view of the table's plane (paper section 4.2).

    The first two arguments may be lists, of several cameras: each pixel then shows the camera with the most pixels of
    that part of the table.

    Args:
        rgb: (H, W, 3) uint8.
        camera: calibrated camera of the image.
        workspace: the square on the table that the view shows.
        size: rows and columns of the view.
        plane_height: height above the table, metres, of the plane that is mapped without parallax.

    Returns:
        (size, size, 3) uint8; rows grow with the world's x, columns with y; black outside the camera's image.

    Raises:
        ValueError: if an image's shape or dtype is wrong, the plane lies partly behind a camera, or lists differ in
            length.
    """
    if isinstance(camera, Camera):
        rgb, camera = [rgb], [camera]  # type: ignore[list-item]
    frame, *others = [Frame(color, None, one, workspace) for color, one in zip(rgb, camera, strict=True)]
    further = {str(number): other for number, other in enumerate(others, start=2)}
    view = PerspectiveView(size, plane_height, gripper=False, cameras=CameraNames(further))
    return view.render(replace(frame, others=further))["persp"]


@dataclass(frozen=True)
class PerspectiveView(View):
    """RGB perspective: the homography of a plane parallel to the table to a top-down image, and a gripper image."""

    size: int = 152
    """Rows and columns."""
    plane_height: Literal["gripper"] | float = 0.0
    """Height of the plane that is mapped without parallax, metres above the table; `gripper` follows the gripper."""
    gripper: bool = True
    """Add `persp_gripper` if the gripper's state is known: the fingers as squares whose brightness is the gripper's
    height."""
    cameras: CameraNames = NO_CAMERAS
    """Cameras whose images the view merges, such as `[side, left]`: each pixel shows the camera that has the most
    pixels of that part of the plane. The view's own camera is always one of them."""

    @property
    def outputs(self) -> dict[str, Kind]:
        """The warped image and the gripper image."""
        outputs: dict[str, Kind] = {"persp": "rgb"}
        if self.gripper:
            outputs["persp_gripper"] = "rgb"
        return outputs

    @property
    def uses_gripper(self) -> bool:
        """True if the gripper image is on or the plane follows the gripper."""
        return self.gripper or self.plane_height == "gripper"

    def __post_init__(self) -> None:
        check_size(self.size)
        object.__setattr__(self, "cameras", checked_cameras(self.cameras))  # frozen; JSON has lists
        if self.plane_height != "gripper" and (
            isinstance(self.plane_height, str) or not math.isfinite(self.plane_height)
        ):
            raise OptionError(f"plane_height must be gripper or a height in metres, got {self.plane_height!r}")

    def without_gripper(self) -> PerspectiveView:
        """Return the view without the gripper image.

        Raises:
            ValueError: if the plane follows the gripper.
        """
        self.plane(None)
        return replace(self, gripper=False)

    def plane(self, gripper_height: float | None) -> float:
        """Return the height of the warped plane, metres, for a gripper at `gripper_height`."""
        if self.plane_height != "gripper":
            return float(self.plane_height)
        if gripper_height is None:
            raise ValueError("plane_height=gripper needs the gripper's state; without it, give a height in metres")
        return gripper_height

    def render(self, frame: Frame) -> dict[str, NDArray]:
        """Return the warped image and, if the gripper's state is known, the gripper image."""
        plane_height = self.plane(frame.gripper_height)
        images = {"persp": self._warped(frame, plane_height)}
        if self.gripper and frame.gripper is not None:
            from lerobot_symview.geometry.gripper import gripper_image_uint8  # slow import: numba

            images["persp_gripper"] = gray_to_rgb(gripper_image_uint8(frame.gripper, frame.workspace, self.size))
        return images

    def _warped(self, frame: Frame, plane_height: float) -> NDArray[np.uint8]:
        """Return the warped image (size, size, 3) uint8; of several cameras, by the best at each pixel."""
        frames = self.merged(frame)
        if len(frames) > 1:
            frames = [one for one in frames if one.rgb.any()] or [frame]  # a camera that delivers nothing is black
        warps = [(warp_map(one.camera, frame.workspace, self.size, plane_height), one) for one in frames]
        images = [warp_plane(one.rgb, warp) for warp, one in warps]
        if len(images) == 1:
            return images[0]
        density = [
            np.where(
                inside_image(warp, one.camera),
                pixel_density(one.camera, frame.workspace, self.size, plane_height),
                -1.0,
            )
            for warp, one in warps
        ]
        best = np.argmax(density, axis=0)
        chosen: NDArray[np.uint8] = np.take_along_axis(np.stack(images), best[None, ..., None], axis=0)[0]
        return chosen
