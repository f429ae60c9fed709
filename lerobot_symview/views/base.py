"""Views: images from above, made from one camera frame by a pure function with a frozen configuration.

`VIEWS` is the one registry that the offline command and the online processor step read. A new view is a frozen
dataclass with the members of `View`, decorated with `@register_view(name)`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any, ClassVar, Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.registry import added, lookup

SMALLEST, LARGEST = 8, 4096  # rows and columns of a view


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


def gray_to_rgb(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Repeat a grey image (H, W) uint8 in three channels: (H, W, 3)."""
    return np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB), dtype=np.uint8)


def gripper_height(frame: Frame) -> float | None:
    """Return the gripper's height above the table, metres; None where its state is not known."""
    return None if frame.gripper is None else float(frame.gripper[2])


def check_size(size: int) -> None:
    """Raise a ValueError unless `size` is a view's number of rows and columns."""
    if not isinstance(size, Integral) or not SMALLEST <= size <= LARGEST:
        raise ValueError(f"a view's size must be a whole number of {SMALLEST} to {LARGEST} pixels, got {size}")
