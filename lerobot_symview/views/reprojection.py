"""The view `reproj`: RGBD reprojected to a top-down image (paper section 4.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from numbers import Integral
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.units import in_metres
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views.base import Frame, Kind, View, ViewSpec, check_size, gray_to_rgb

INFILLS = ("nearest", "local", "none")


class Reprojection(NamedTuple):
    """A reprojected RGBD image.

    Attributes:
        rgb: (size, size, 3) uint8; rows grow with the world's x, columns with y.
        height: (size, size) float32, metres above the table.
        seen: (size, size) bool, whether the camera measured a point there; elsewhere colour and height are inferred.
    """

    rgb: NDArray[np.uint8]
    height: NDArray[np.float32]
    seen: NDArray[np.bool_]


def reproject(
    rgb: NDArray[np.uint8],
    depth: NDArray,
    camera: Camera,
    workspace: Workspace,
    gripper: NDArray[np.floating] | None = None,
    **options: Any,
) -> Reprojection:
    """Reproject an RGBD image to a top-down view of the workspace (paper section 4.1).

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) along the optical axis, float metres or integer millimetres; 0, negative or non-finite = invalid.
        camera: its calibration.
        workspace: the square on the table that is shown.
        gripper: (5,) x, y (metres, relative to the workspace centre), z (metres), yaw (rad), aperture. Where it is
            given, points above the gripper, which are the arm's, are dropped.
        options: of `ReprojectedView`, such as `size=128` or `infill="none"`.

    Returns:
        Colour, height and which pixels were seen.

    Raises:
        ValueError: if an image's shape or dtype is wrong, or there is no such option.

    Example:
        ```python
        import lerobot_symview as sv

        camera = sv.Camera(K, world_from_cam, height=480, width=640)
        top = sv.reproject(rgb, depth, camera, sv.Workspace(center=(0.45, 0.0), size=0.4))
        top.rgb  # (152, 152, 3)
        ```
    """
    view = ViewSpec("reproj", options | {"height": True, "mask": True}).make()
    gripper = None if gripper is None else np.asarray(gripper)
    images = view.render(Frame(rgb, in_metres(depth), camera, workspace, gripper))
    return Reprojection(images["reproj"], images["reproj_height"], images["reproj_seen"][..., 0] > 0)


@dataclass(frozen=True)
class ReprojectedView(View):
    """RGBD reprojection: the frame's point cloud, projected orthographically from above (paper section 4.1)."""

    size: int = 152
    """Rows and columns."""
    infill: Literal["nearest", "local", "none"] = "nearest"
    """Fill of pixels without a point: the nearest point's (the paper's best), the mean of those nearby, or black."""
    clip: Literal["gripper", "none"] | float = "gripper"
    """Drop points above the gripper, which removes the arm, where its state is known; `none` keeps all points; a number
    drops those above that height, metres."""
    clip_margin: float = 0.01
    """Metres below the gripper at which points are dropped, since the fingers reach below its position."""
    clip_floor: float = 0.06
    """Height in metres below which no point is dropped, so that what the gripper touches stays visible."""
    source_scale: int = 1
    """Upsample the depth image by this factor first, so that one surface leaves no gaps between its points."""
    height: bool = True
    """Add `reproj_height`: metres above the table, one channel, which LeRobot's own policies do not take."""
    mask: bool = False
    """Add `reproj_seen`: white where the camera measured a point, black where the image is inferred."""

    @property
    def outputs(self) -> dict[str, Kind]:
        """Colour, height above the table, and the mask."""
        outputs: dict[str, Kind] = {"reproj": "rgb"}
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
    def uses_gripper(self) -> bool:
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

    def without_gripper(self) -> ReprojectedView:
        """Keep all points."""
        return replace(self, clip="none") if self.uses_gripper else self

    def with_mask(self) -> ReprojectedView:
        """Add `reproj_seen`."""
        return replace(self, mask=True)

    def render(self, frame: Frame) -> dict[str, NDArray]:
        """Return the outputs; black and 0 where nothing is known."""
        from lerobot_symview.geometry import infill, upsampling, zbuffer  # numba: too slow for a plugin's import

        if frame.depth is None:
            raise ValueError("the view 'reproj' needs depth; for a camera without it use 'persp'")
        depth, camera, rgb = frame.depth, frame.camera, frame.rgb
        if self.source_scale > 1:
            depth, camera = upsampling.enlarge_depth(depth, self.source_scale), _enlarged(camera, self.source_scale)
            rgb = rgb.repeat(self.source_scale, axis=0).repeat(self.source_scale, axis=1)
        buffer = zbuffer.zbuffer_from_depth(
            [depth], [camera], frame.workspace, self.size, self.ceiling(frame.gripper_height)
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
        """Return the height above which points are dropped, metres; infinite where the gripper's height is unknown."""
        if self.clip == "gripper":
            return np.inf if gripper_height is None else max(gripper_height - self.clip_margin, self.clip_floor)
        return np.inf if self.clip == "none" else float(self.clip)


@lru_cache(maxsize=64)
def _enlarged(camera: Camera, factor: int) -> Camera:
    return camera.enlarged(factor)


@lru_cache(maxsize=8)
def _every_cell(pixels: int) -> NDArray[np.int32]:
    return np.arange(pixels**2, dtype=np.int32).reshape(pixels, pixels)
