"""The view `persp`: RGB warped by the homography of a plane parallel to the table (paper section 4.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from numpy.typing import NDArray

from lerobot_symview.geometry.homography import warp_map, warp_plane
from lerobot_symview.views.base import Frame, check_size, gray_to_rgb, gripper_height, register_view


@register_view("persp")
@dataclass(frozen=True)
class PerspectiveView:
    """RGB perspective: a plane parallel to the table warped to lie flat, and the gripper drawn (paper section 4.2)."""

    size: int = 152
    """Rows and columns."""
    plane_height: Literal["gripper"] | float = 0.0
    """Metres above the table of the plane that is mapped exactly; `gripper` moves it with the gripper."""
    gripper: bool = True
    """Add `persp_gripper`: the fingers drawn where they are, the brighter the higher."""

    @property
    def outputs(self) -> dict[str, Literal["rgb", "height"]]:
        """The warped image and the gripper image."""
        outputs: dict[str, Literal["rgb", "height"]] = {"persp": "rgb"}
        if self.gripper:
            outputs["persp_gripper"] = "rgb"
        return outputs

    @property
    def needs_depth(self) -> bool:
        """Never."""
        return False

    @property
    def needs_gripper(self) -> bool:
        """To draw it and to follow it."""
        return self.gripper or self.plane_height == "gripper"

    def __post_init__(self) -> None:
        check_size(self.size)
        if self.plane_height != "gripper" and (
            isinstance(self.plane_height, str) or not math.isfinite(self.plane_height)
        ):
            raise ValueError(f"plane_height must be gripper or a height in metres, got {self.plane_height!r}")

    def plane(self, gripper_height: float | None) -> float:
        """Return the height of the plane that is mapped exactly, metres, for a gripper at `gripper_height`."""
        if self.plane_height != "gripper":
            return float(self.plane_height)
        if gripper_height is None:
            raise ValueError("plane_height=gripper needs the gripper's state; without it, state a height in metres")
        return gripper_height

    def render(self, frame: Frame) -> dict[str, NDArray]:
        """Return the warped image and the gripper image (grey, brightness = height)."""
        plane_height = self.plane(gripper_height(frame))
        images = {"persp": warp_plane(frame.rgb, warp_map(frame.camera, frame.workspace, self.size, plane_height))}
        if self.gripper:
            if frame.gripper is None:
                raise ValueError("the gripper image needs the gripper's state; without it, gripper=false")
            from lerobot_symview.geometry.gripper import gripper_picture  # for the same reason

            images["persp_gripper"] = gray_to_rgb(gripper_picture(frame.gripper, frame.workspace, self.size))
        return images
