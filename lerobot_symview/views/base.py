"""Interface and registry of views. A view maps one camera frame to top-down images; its options are frozen.

The dataset command, the processor step and the simulators share the registry `VIEWS`. A new view is a frozen dataclass
derived from `View` and decorated with `@register_view(name)`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from numbers import Integral
from typing import Any, ClassVar, Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_symview import keys
from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.visibility import check_above_table
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.registry import Registry

SMALLEST, LARGEST = 8, 4096  # rows and columns of a view
# No table robot exceeds these; millimetres, degrees and percent do. A continuous yaw may have turned a few times.
STATE_LIMITS = (10.0, 10.0, 10.0, 40.0, 2.0)
METRES_FROM_CENTER = "metres relative to the workspace's centre"
STATE_UNITS = (METRES_FROM_CENTER, METRES_FROM_CENTER, "metres above the table", "radians", "a fraction from 0 to 1")
Kind = Literal["rgb", "height"]


@dataclass(frozen=True, eq=False)
class Frame:
    """One camera's images at one time step, its calibration, and the gripper's state.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float, metres along the optical axis; 0, negative or non-finite = invalid; None for RGB cameras.
        camera: calibrated camera.
        workspace: the square on the table that views show.
        gripper: (5,) float: x, y (metres, relative to the workspace centre), z (metres), yaw (rad), aperture in
            [0, 1]; None if unknown: then no point is clipped and no gripper image is drawn.
        others: frames of further cameras at the same time step and over the same workspace, by the camera's name, for
            views that merge cameras; their gripper is not used.

    Raises:
        ValueError: if an image's shape or dtype is wrong, the gripper's state is not finite, or another frame has
            another workspace.
        CalibrationError: if the camera is below the table.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.floating] | None
    camera: Camera
    workspace: Workspace
    gripper: NDArray[np.floating] | None = None
    others: Mapping[str, Frame] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_above_table(self.camera)
        # Compiled kernels index the images by the camera's size without bounds checks.
        size = (self.camera.height, self.camera.width)
        if self.rgb.shape != (*size, 3) or self.rgb.dtype != np.uint8:
            raise ValueError(f"rgb must be {(*size, 3)} uint8 as its camera, got {self.rgb.shape} {self.rgb.dtype}")
        if self.depth is not None and (self.depth.shape != size or self.depth.dtype.kind != "f"):
            raise ValueError(
                f"depth must be {size} float metres as its camera, got {self.depth.shape} {self.depth.dtype}"
            )
        if self.gripper is not None:
            check_gripper(self.gripper.tolist())
        if any(other.workspace != self.workspace for other in self.others.values()):
            raise ValueError("the frames of several cameras must have one workspace")

    @property
    def gripper_height(self) -> float | None:
        """The gripper's height above the table, metres; None if its state is unknown."""
        return None if self.gripper is None else float(self.gripper[2])


def check_gripper(state: list[float]) -> None:
    """Raise a ValueError if a gripper's state cannot be in metres, radians and [0, 1].

    Points would be clipped at a wrong height, and the gripper image would be empty.

    Args:
        state: x, y, z, yaw, aperture.
    """
    if not all(map(math.isfinite, state)):
        raise ValueError(f"the gripper's x, y, z, yaw and aperture must be finite, got {state}")
    for value, limit, name, expected in zip(state, STATE_LIMITS, keys.STATE_NAMES, STATE_UNITS, strict=True):
        if abs(value) > limit:
            raise ValueError(f"the gripper's {name} is {value:g}, expected {expected}")


class View(ABC):
    """Base class of views. Derived classes are frozen dataclasses; their fields are the view's options."""

    __dataclass_fields__: ClassVar[dict[str, Any]]
    size: int  # rows and columns of every output
    cameras: Sequence[str] = ()  # cameras whose images the view merges with its own camera's
    memory: bool = False  # whether an image depends on the earlier frames of the episode

    @property
    @abstractmethod
    def outputs(self) -> Mapping[str, Kind]:
        """Suffix of the feature key -> "rgb" ((size, size, 3) uint8) or "height" ((size, size) float32, metres)."""

    @property
    def needs_depth(self) -> bool:
        """Whether the view requires depth."""
        return False

    @property
    def uses_gripper(self) -> bool:
        """Whether the outputs depend on the gripper's state if it is known."""
        return False

    @abstractmethod
    def render(self, frame: Frame) -> dict[str, NDArray]:
        """Return one image for each entry of `outputs`."""

    def start_episode(self) -> Callable[[Frame], dict[str, NDArray]]:
        """Return a function that renders the frames of one episode in order, for views that remember earlier ones."""
        return self.render

    def without_gripper(self) -> Self:
        """Return the variant of the view for frames without the gripper's state."""
        return self

    def merged(self, frame: Any) -> list[Any]:
        """Return the frames that the view merges: that of its own camera, and those of `cameras` that are there.

        Args:
            frame: a `Frame`, or a `FrameBatch` (`lerobot_symview.views.torch_backend`).
        """
        return [frame, *(frame.others[name] for name in self.cameras if name in frame.others)]

    def with_mask(self) -> Self:
        """Return the variant of the view that also outputs a mask of measured pixels, if the view supports one."""
        return self

    def in_color(self) -> Self:
        """Return the variant of the view without height maps, for policies that accept three-channel images only.

        Raises:
            ValueError: if a one-channel output cannot be disabled.
        """
        view = replace(self, height=False) if "height" in option_names(type(self)) else self
        single = [output for output, kind in view.outputs.items() if kind == "height"]
        if single:
            raise ValueError(f"the view outputs {', '.join(single)}, which has one channel")
        return view


VIEWS: Registry[Callable[..., View]] = Registry(
    "view",
    "symview.views",
    {
        "reproj": "lerobot_symview.views.reprojection:ReprojectedView",
        "persp": "lerobot_symview.views.perspective:PerspectiveView",
    },
)
register_view = VIEWS.register


def make_view(name: str, **options: Any) -> View:
    """Return the view registered as `name`.

    Raises:
        OptionError: if the view or an option is unknown, or an option's value is invalid.
    """
    return ViewSpec(name, options).make()


class ViewSpec:
    """Specification of a view: its name and its options.

    Command lines and files spell it as a name, `reproj`, or as a mapping, `{name: persp, plane_height: 0.025}`.

    Args:
        name: key of the view in `VIEWS`.
        options: keyword arguments of the view; options not given keep their defaults.
    """

    def __init__(self, name: str, options: Mapping[str, Any] | None = None):
        self.name, self.options = name, dict(options or {})

    @classmethod
    def parse(cls, entry: str | Mapping[str, Any] | ViewSpec) -> ViewSpec:
        """Return the specification given by a name or a mapping.

        Raises:
            OptionError: if `entry` is neither.
        """
        if isinstance(entry, ViewSpec):
            return entry
        if isinstance(entry, str):
            return cls(entry)
        if not isinstance(entry, Mapping) or not isinstance(entry.get("name"), str):
            raise OptionError(f"a view must be a name or a mapping with a name and options, got {entry!r}")
        return cls(entry["name"], {key: value for key, value in entry.items() if key != "name"})

    def make(self) -> View:
        """Return the view.

        Raises:
            OptionError: if the view or an option is unknown, or an option's value is invalid.
        """
        try:
            cls = VIEWS[self.name]
        except ValueError as error:
            raise OptionError(str(error)) from None
        known = option_names(cls)
        unknown = sorted(set(self.options) - set(known))
        if unknown:
            raise OptionError(f"the view {self.name!r} has no option {', '.join(unknown)}; it has {', '.join(known)}")
        try:
            return cls(**self.options)
        except (TypeError, ValueError) as error:  # such as a text compared with a number
            raise OptionError(f"the view {self.name!r} cannot have the options {self.options}: {error}") from None

    def plain(self) -> dict[str, Any]:
        """Return the mapping that `parse` reads."""
        return {"name": self.name, **self.options}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ViewSpec) and self.plain() == other.plain()

    def __hash__(self) -> int:
        return hash(self.name)

    def __repr__(self) -> str:
        return f"ViewSpec({self.name!r}, {self.options!r})"


def option_names(view: Any) -> list[str]:
    """Return the option names of a view class."""
    return [option.name for option in fields(view)]


def make_views(specs: Iterable[ViewSpec]) -> dict[str, View]:
    """Return the views by name.

    Raises:
        OptionError: if `specs` is empty or contains a name twice, or a view is unknown or invalid.
    """
    views: dict[str, View] = {}
    for spec in specs:
        if spec.name in views:
            raise OptionError(f"the view {spec.name!r} is given twice")
        views[spec.name] = spec.make()
    if not views:
        raise OptionError("expected at least one view, got none")
    return views


def other_cameras(views: Iterable[View], camera: str) -> list[str]:
    """Return the names of the cameras that views of `camera` merge with it."""
    return list(dict.fromkeys(name for view in views for name in view.cameras if name != camera))


def gray_to_rgb(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert a grey image (H, W) uint8 to three equal channels (H, W, 3)."""
    return np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB), dtype=np.uint8)


def check_size(size: int) -> None:
    """Raise an OptionError unless `size` is a valid number of rows and columns of a view."""
    if not isinstance(size, Integral) or not SMALLEST <= size <= LARGEST:
        raise OptionError(f"a view's size must be an integer from {SMALLEST} to {LARGEST} pixels, got {size}")


class CameraNames(tuple[str, ...]):
    """Names of the cameras that a view merges. Command lines spell it as a name or a list, `left` or `[side, left]`."""


NO_CAMERAS = CameraNames()


def checked_cameras(cameras: str | Iterable[str]) -> CameraNames:
    """Return the names of the cameras that a view merges.

    Raises:
        OptionError: if they are no names, or a name is given twice.
    """
    listed = [cameras] if isinstance(cameras, str) else list(cameras)
    if not all(isinstance(name, str) and name for name in listed):
        raise OptionError(f"cameras must be a list of names, such as [side, left], got {cameras!r}")
    names = CameraNames(listed)
    if len(set(names)) < len(names):
        raise OptionError(f"cameras must differ, got {', '.join(names)}")
    return names
