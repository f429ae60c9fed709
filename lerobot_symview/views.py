"""Views: images from above, made from one camera frame by a pure function with a frozen configuration.

`VIEWS` is the one registry that the offline command and the online processor step read. A new view is a frozen
dataclass with the members of `View`, decorated with `@register_view(name)`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from numbers import Integral
from typing import Any, ClassVar, Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_symview.camera import Camera, depth_in_metres
from lerobot_symview.names import added, lookup
from lerobot_symview.perspective import warp_map, warp_plane
from lerobot_symview.workspace import Workspace

SMALLEST, LARGEST = 8, 4096  # rows and columns of a view
INFILLS = ("nearest", "local", "none")


@dataclass(frozen=True, eq=False)
class Frame:
    """What one camera and the gripper's encoders say at one moment.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) along the optical axis, float metres or integer millimetres; 0, negative or non-finite = invalid;
            None without a sensor.
        camera: calibration.
        workspace: what the view shows.
        gripper: (5,) float: x, y (metres, relative to the workspace centre), z (metres), yaw (rad), aperture; None
            where it is not known.

    Raises:
        ValueError: if an image's size is not the camera's, or its type another, or the gripper's state is not finite.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray | None
    camera: Camera
    workspace: Workspace
    gripper: NDArray[np.floating] | None = None

    def __post_init__(self) -> None:
        # Compiled kernels read the images by the camera's size and check no index.
        size = (self.camera.height, self.camera.width)
        if self.rgb.shape != (*size, 3) or self.rgb.dtype != np.uint8:
            raise ValueError(f"rgb must be {(*size, 3)} uint8 as its camera, got {self.rgb.shape} {self.rgb.dtype}")
        if self.depth is not None and (self.depth.shape != size or self.depth.dtype.kind not in "fiu"):
            raise ValueError(
                f"depth must be {size} float or integer as its camera, got {self.depth.shape} {self.depth.dtype}"
            )
        if self.gripper is not None:
            check_gripper(self.gripper.tolist())


def check_gripper(state: list[float]) -> None:
    """Raise a ValueError for a gripper's state that is not finite: it would cut off or hide all there is."""
    if not all(map(math.isfinite, state)):
        raise ValueError(f"the gripper's x, y, z, yaw and aperture must be finite, got {state}")


class View(Protocol):
    """A way of looking at a frame from above: a frozen dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def size(self) -> int:
        """Rows and columns of every output."""
        ...

    @property
    def outputs(self) -> dict[str, Literal["rgb", "height"]]:
        """Suffix of the feature -> "rgb" (uint8, (size, size, 3)) or "height" (float32, (size, size), metres)."""
        ...

    @property
    def needs_depth(self) -> bool:
        """Whether the frame must have depth."""
        ...

    @property
    def needs_gripper(self) -> bool:
        """Whether the frame must say where the gripper is."""
        ...

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
    """Return the view `name`, a registered one or an entry point of the group `symview.views`.

    Raises:
        ValueError: if there is none; it names the nearest.
    """
    if name in VIEWS:
        return VIEWS[name](**options)
    others = added("symview.views")
    lookup("view", name, dict.fromkeys((*VIEWS, *others)))
    view: View = others[name].load()(**options)
    return view


def choose_views(names: list[str], size: int | None, options: dict[str, View]) -> dict[str, View]:
    """Return the views `names`, each as `options` state it or with its defaults, all of `size` pixels if that is given.

    Raises:
        ValueError: if there is no name, or one that is unknown.
    """
    if not names:
        raise ValueError("--views is empty, name at least one view")
    views = {name: options[name] if name in options else make_view(name) for name in names}
    return views if size is None else {name: replace(view, size=size) for name, view in views.items()}


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
        _check_size(self.size)
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
        from lerobot_symview import infill, upsampling, zbuffer  # numba takes a second, and a plugin must load fast

        if frame.depth is None:
            raise ValueError("the view 'reproj' needs depth; for a camera without it use 'persp'")
        depth, camera, rgb = depth_in_metres(frame.depth), frame.camera, frame.rgb
        if self.source_scale > 1:
            depth, camera = upsampling.enlarge_depth(depth, self.source_scale), _enlarged(camera, self.source_scale)
            rgb = rgb.repeat(self.source_scale, axis=0).repeat(self.source_scale, axis=1)
        buffer = zbuffer.zbuffer_from_depth([depth], [camera], frame.workspace, self.size, self.ceiling(_height(frame)))
        seen = buffer.source != zbuffer.EMPTY
        shown = infill.nearest_known(seen) if self.infill == "nearest" else _every_cell(self.size)
        colors, height = zbuffer.gather(shown, buffer, rgb.reshape(-1, 3))
        if self.infill == "local":
            colors, height = infill.fill_local(colors, seen), infill.fill_local(height, seen)
        images: dict[str, NDArray] = {"reproj": colors, "reproj_height": height}
        if self.mask:
            images["reproj_seen"] = _three_channels(seen.astype(np.uint8) * np.uint8(255))
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
        _check_size(self.size)
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
        plane_height = self.plane(_height(frame))
        images = {"persp": warp_plane(frame.rgb, warp_map(frame.camera, frame.workspace, self.size, plane_height))}
        if self.gripper:
            if frame.gripper is None:
                raise ValueError("the gripper image needs the gripper's state; without it, gripper=false")
            from lerobot_symview.gripper import gripper_picture  # for the same reason

            images["persp_gripper"] = _three_channels(gripper_picture(frame.gripper, frame.workspace, self.size))
        return images


@lru_cache(maxsize=64)
def _enlarged(camera: Camera, factor: int) -> Camera:
    return camera.enlarged(factor)


def _three_channels(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), dtype=np.uint8)


@lru_cache(maxsize=8)
def _every_cell(pixels: int) -> NDArray[np.int32]:
    return np.arange(pixels**2, dtype=np.int32).reshape(pixels, pixels)


def _height(frame: Frame) -> float | None:
    return None if frame.gripper is None else float(frame.gripper[2])


def _check_size(size: int) -> None:
    if not isinstance(size, Integral) or not SMALLEST <= size <= LARGEST:
        raise ValueError(f"a view's size must be a whole number of {SMALLEST} to {LARGEST} pixels, got {size}")
