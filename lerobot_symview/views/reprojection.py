"""The view `reproj`: RGBD reprojected to a top-down image (paper section 4.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from numbers import Integral
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Camera, depth_in_metres
from lerobot_symview.views.base import Frame, check_size, gray_to_rgb, gripper_height, register_view

INFILLS = ("nearest", "local", "none")


@register_view("reproj")
@dataclass(frozen=True)
class ReprojectedView:
    """RGBD reprojection: the point cloud of the frame drawn orthographically from above (paper section 4.1)."""

    size: int = 152
    """Rows and columns."""
    infill: Literal["nearest", "local", "none"] = "nearest"
    """What to put where no point fell: the nearest one (the paper's best), the mean of those nearby, or black."""
    clip: Literal["gripper", "none"] | float = "gripper"
    """Drop points higher than the gripper, which removes the arm; `none` keeps all; a number cuts at as many metres."""
    clip_margin: float = 0.01
    """Metres below the gripper at which the cut lies, since the fingers reach below its position."""
    clip_floor: float = 0.06
    """Metres under which the gripper cuts nothing, so that what it touches stays visible."""
    source_scale: int = 1
    """Interpolate the depth image to so many times its rows and columns first, so that no gaps are left between points
    of one surface."""
    height: bool = True
    """Add `reproj_height`: metres above the table, one channel, which LeRobot's own policies do not take."""
    mask: bool = False
    """Add `reproj_seen`: white where a point was seen, black where it is inferred from others."""

    @property
    def outputs(self) -> dict[str, Literal["rgb", "height"]]:
        """Colour, height above the table, and the mask."""
        outputs: dict[str, Literal["rgb", "height"]] = {"reproj": "rgb"}
        if self.height:
            outputs["reproj_height"] = "height"
        if self.mask:
            outputs["reproj_seen"] = "rgb"
        return outputs

    @property
    def needs_depth(self) -> bool:
        """Always."""
        return True

    @property
    def needs_gripper(self) -> bool:
        """Only to clip there."""
        return self.clip == "gripper"

    def __post_init__(self) -> None:
        check_size(self.size)
        if self.infill not in INFILLS:
            raise ValueError(f"infill must be one of {', '.join(INFILLS)}, got {self.infill!r}")
        if self.clip not in ("gripper", "none") and (isinstance(self.clip, str) or not self.clip > -math.inf):
            raise ValueError(f"clip must be gripper, none or a height in metres, got {self.clip!r}")
        for name, metres in {"clip_margin": self.clip_margin, "clip_floor": self.clip_floor}.items():
            if not math.isfinite(metres):
                raise ValueError(f"{name} must be finite metres, got {metres}")
        if not isinstance(self.source_scale, Integral) or not 1 <= self.source_scale <= 8:
            raise ValueError(f"source_scale must be a whole number in 1 to 8, got {self.source_scale}")

    def render(self, frame: Frame) -> dict[str, NDArray]:
        """Return the outputs; where nothing is known, black and 0."""
        from lerobot_symview.geometry import (  # numba takes a second, and a plugin must load fast
            infill,
            upsampling,
            zbuffer,
        )

        if frame.depth is None:
            raise ValueError("the view 'reproj' needs depth; for a camera without it use 'persp'")
        depth, camera, rgb = depth_in_metres(frame.depth), frame.camera, frame.rgb
        if self.source_scale > 1:
            depth, camera = upsampling.enlarge_depth(depth, self.source_scale), _enlarged(camera, self.source_scale)
            rgb = rgb.repeat(self.source_scale, axis=0).repeat(self.source_scale, axis=1)
        buffer = zbuffer.zbuffer_from_depth(
            [depth], [camera], frame.workspace, self.size, self.ceiling(gripper_height(frame))
        )
        seen = buffer.source != zbuffer.EMPTY
        shown = infill.nearest_known(seen) if self.infill == "nearest" else _every_cell(self.size)
        colors, height = zbuffer.gather(shown, buffer, rgb.reshape(-1, 3))
        if self.infill == "local":
            colors, height = infill.fill_local(colors, seen), infill.fill_local(height, seen)
        images: dict[str, NDArray] = {"reproj": colors, "reproj_height": height}
        if self.mask:
            images["reproj_seen"] = gray_to_rgb(seen.astype(np.uint8) * np.uint8(255))
        return {output: images[output] for output in self.outputs}

    def ceiling(self, gripper_height: float | None) -> float:
        """Return the height above which points are left out, metres, for a gripper at `gripper_height`."""
        if self.clip == "none":
            return np.inf
        if self.clip == "gripper":
            if gripper_height is None:
                raise ValueError("clip=gripper needs the gripper's state; without it, clip=none or a height in metres")
            return max(gripper_height - self.clip_margin, self.clip_floor)
        return float(self.clip)


@lru_cache(maxsize=64)
def _enlarged(camera: Camera, factor: int) -> Camera:
    return camera.enlarged(factor)


@lru_cache(maxsize=8)
def _every_cell(pixels: int) -> NDArray[np.int32]:
    return np.arange(pixels**2, dtype=np.int32).reshape(pixels, pixels)
