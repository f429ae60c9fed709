"""Views: images from above, made from one camera frame by a pure function with a frozen configuration.

`VIEWS` is the one registry that the offline command and the online processor step read. A new view is a frozen
dataclass with `outputs`, `needs_depth` and `render`, decorated with `@register_view(name)`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.camera import Camera, unproject
from lerobot_symview.gripper import gripper_image
from lerobot_symview.names import lookup
from lerobot_symview.perspective import image_from_topdown, warp_plane
from lerobot_symview.reproject import EMPTY, INFILLS, fill_local, fill_nearest, zbuffer
from lerobot_symview.workspace import Workspace


@dataclass(frozen=True, eq=False)
class Frame:
    """What one camera and the gripper's encoders say at one moment.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float, metres along the optical axis; 0, negative or non-finite = invalid; None without a sensor.
        camera: calibration.
        workspace: what the view shows.
        gripper: (5,) float: x, y (metres, relative to the workspace centre), z (metres), yaw (rad), aperture.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.floating] | None
    camera: Camera
    workspace: Workspace
    gripper: NDArray[np.floating]


class View(Protocol):
    """A way of looking at a frame from above."""

    @property
    def size(self) -> int:
        """Rows and columns of every output."""
        ...

    # Suffix of the feature -> "rgb" (uint8, (size, size, 3)) or "height" (float32, (size, size), metres).
    outputs: ClassVar[dict[str, str]]
    needs_depth: ClassVar[bool]

    def render(self, frame: Frame) -> dict[str, NDArray]:
        """Return the image of every output."""
        ...


VIEWS: dict[str, Callable[..., View]] = {}


def register_view(name: str) -> Callable[[type], type]:
    """Make a view selectable by `name`."""

    def register(cls: type) -> type:
        if name in VIEWS:
            raise ValueError(f"a view named {name!r} is registered already")
        VIEWS[name] = cls
        return cls

    return register


def make_view(name: str, **options: Any) -> View:
    """Return the view `name`; an unknown name is answered with the nearest known one."""
    return lookup("view", name, VIEWS)(**options)


@register_view("reproj")
@dataclass(frozen=True)
class ReprojectedView:
    """RGBD reprojection: the point cloud of the frame drawn orthographically from above (paper section 4.1).

    Args:
        size: rows and columns.
        infill: what to put where no point fell, `nearest` (the paper's best), `local` or `none`.
        clip: `gripper` drops points higher than the gripper, which removes the arm; `none` keeps all.
        clip_margin: metres below the gripper at which the cut lies, since the fingers reach below its position.
        clip_floor: metres under which nothing is cut, so that what the gripper touches stays visible.
    """

    size: int = 152
    infill: Literal["nearest", "local", "none"] = "nearest"
    clip: Literal["gripper", "none"] = "gripper"
    clip_margin: float = 0.01
    clip_floor: float = 0.06

    outputs: ClassVar[dict[str, str]] = {"reproj": "rgb", "reproj_height": "height"}
    needs_depth: ClassVar[bool] = True

    def __post_init__(self) -> None:
        _check_size(self.size)
        _check_choice("infill", self.infill, INFILLS)
        _check_choice("clip", self.clip, ("gripper", "none"))

    def render(self, frame: Frame) -> dict[str, NDArray]:
        """Return colour and height above the table; where nothing is known, black and 0."""
        if frame.depth is None:
            raise ValueError("the view 'reproj' needs depth; for a camera without it use 'persp'")
        measured = np.isfinite(frame.depth) & (frame.depth > 0)
        points = unproject(np.where(measured, frame.depth, 0), frame.camera).reshape(-1, 3)
        valid = measured.ravel()
        if self.clip == "gripper":
            ceiling = max(float(frame.gripper[2]) - self.clip_margin, self.clip_floor)
            valid &= points[:, 2] <= ceiling
        source = zbuffer(points, valid, frame.workspace, self.size)
        if self.infill == "nearest":
            source = fill_nearest(source)
        known = source != EMPTY
        rgb = np.where(known[..., None], frame.rgb.reshape(-1, 3)[source], 0).astype(np.uint8)
        height = np.where(known, points[source, 2], 0.0).astype(np.float32)
        if self.infill == "local":
            rgb, height = fill_local(rgb, known), fill_local(height, known)
        return {"reproj": rgb, "reproj_height": height}


@register_view("persp")
@dataclass(frozen=True)
class PerspectiveView:
    """RGB perspective: a plane parallel to the table warped to lie flat, and the gripper drawn (paper section 4.2).

    Args:
        size: rows and columns.
        plane_height: metres above the table of the plane that is mapped exactly.
    """

    size: int = 152
    plane_height: float = 0.0

    outputs: ClassVar[dict[str, str]] = {"persp": "rgb", "persp_gripper": "rgb"}
    needs_depth: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _check_size(self.size)

    def render(self, frame: Frame) -> dict[str, NDArray]:
        """Return the warped image and the gripper image (grey, brightness = height)."""
        homography = image_from_topdown(frame.camera, frame.workspace, self.size, self.plane_height)
        gripper = gripper_image(np.asarray(frame.gripper, dtype=np.float64), frame.workspace, self.size)
        grey = np.rint(255 * np.clip(gripper, 0, 1)).astype(np.uint8)
        return {
            "persp": warp_plane(frame.rgb, homography, self.size),
            "persp_gripper": np.repeat(grey[..., None], 3, axis=-1),
        }


def _check_size(size: int) -> None:
    if size < 8:
        raise ValueError(f"a view's size must be at least 8 pixels, got {size}")


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")
