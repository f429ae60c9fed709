"""The view `reproj`: RGBD reprojected to a top-down image (paper section 4.1)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from numbers import Integral
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.camera import Camera, aligned_depth
from lerobot_symview.geometry.units import in_metres
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views.base import (
    NO_CAMERAS,
    CameraNames,
    Frame,
    Kind,
    View,
    ViewSpec,
    check_size,
    checked_cameras,
    gray_to_rgb,
)

if TYPE_CHECKING:
    from lerobot_symview.geometry.memory import Memory

INFILLS = ("nearest", "occlusion", "splat", "local", "none")


class Reprojection(NamedTuple):
    """A reprojected RGBD image.

    Attributes:
        rgb: (size, size, 3) uint8; rows grow with the world's x, columns with y.
        height: (size, size) float32, metres above the table.
        seen: (size, size) bool, whether the camera measured a point; elsewhere colour and height are infilled.
    """

    rgb: NDArray[np.uint8]
    height: NDArray[np.float32]
    seen: NDArray[np.bool_]


class _Source(NamedTuple):
    """What a view reads of a frame: colour (H, W, 3) uint8, depth (H, W) float metres, and their camera."""

    rgb: NDArray[np.uint8]
    depth: NDArray[np.floating]
    camera: Camera


def reproject(
    rgb: NDArray[np.uint8] | Sequence[NDArray[np.uint8]],
    depth: NDArray | Sequence[NDArray],
    camera: Camera | Sequence[Camera],
    workspace: Workspace,
    gripper: NDArray[np.floating] | None = None,
    **options: Any,
) -> Reprojection:
    """Reproject an RGBD image to a top-down view of the workspace (paper section 4.1).

    The first three arguments may be lists, of several cameras: each cell then shows its highest surface by the camera
    that has the most pixels of it (`lerobot_symview.geometry.fusion`).

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) depth along the optical axis, float metres or integer millimetres; 0, negative or non-finite =
            invalid. With `camera.depth_sensor` it is the sensor's image, of any size, and is registered first.
        camera: calibrated camera of the images.
        workspace: the square on the table that the view shows.
        gripper: (5,) x, y (metres, relative to the workspace centre), z (metres), yaw (rad), aperture in
            [0, 1]. If given, points above the gripper, which belong to the arm, are removed.
        options: options of `ReprojectedView`, such as `size=128` or `infill="none"`.

    Returns:
        Colour, height and the mask of measured pixels.

    Raises:
        ValueError: if an image's shape or dtype is wrong, an option is unknown, or lists differ in length.

    Example:
        ```python
        import lerobot_symview as sv

        camera = sv.Camera(K, world_from_cam, height=480, width=640)
        top = sv.reproject(rgb, depth, camera, sv.Workspace(center=(0.45, 0.0), size=0.4))
        top.rgb  # (152, 152, 3)
        ```
    """
    gripper = None if gripper is None else np.asarray(gripper)
    if isinstance(camera, Camera):
        rgb, depth, camera = [rgb], [depth], [camera]  # type: ignore[list-item]
    frame, *others = [
        Frame(color, aligned_depth(in_metres(distance), one), one, workspace, gripper)
        for color, distance, one in zip(rgb, depth, camera, strict=True)
    ]
    further = {str(number): other for number, other in enumerate(others, start=2)}
    view = ViewSpec("reproj", options | {"height": True, "mask": True, "cameras": [*further]}).make()
    images = view.render(replace(frame, others=further))
    return Reprojection(images["reproj"], images["reproj_height"], images["reproj_seen"][..., 0] > 0)


@dataclass(frozen=True)
class ReprojectedView(View):
    """RGBD reprojection: a top-down orthographic projection of the frame's point cloud (paper section 4.1)."""

    size: int = 152
    """Rows and columns."""
    infill: Literal["nearest", "occlusion", "splat", "local", "none"] = "nearest"
    """Infill of pixels without a point: nearest point (the paper's best); the same, but what is behind an object in its
    shadow (occlusion); the point whose footprint covers the pixel, else as occlusion (splat); mean of a 5 x 5 window;
    or none (black)."""
    clip: Literal["gripper", "none"] | float = "gripper"
    """`gripper` removes points above the gripper, and with them the arm, if the gripper's state is known; `none` keeps
    all points; a number removes points above that height, metres."""
    clip_margin: float = 0.01
    """Distance of the clipping height below the gripper's position, metres, since the fingers reach below it."""
    clip_floor: float = 0.06
    """Lowest clipping height, metres, so that an object at the gripper stays visible."""
    clip_radius: float = 0.0
    """Horizontal distance from the gripper within which clipping at the gripper removes points, metres; beyond it,
    points above the working volume are removed. It keeps objects that are higher than the gripper. 0 clips everywhere.
    """
    lowest: float = -0.05
    """Height, metres, below which points are removed: those of the floor beside a table."""
    flying_limit: float = 0.0
    """Remove points that lie between two surfaces, more than this from both, metres: depth cameras measure them at the
    edges of objects. 0 keeps all; 0.02 is a start for a RealSense."""
    source_scale: int = 1
    """Upsample the depth image by this factor first, so that surfaces have no gaps between their points."""
    height: bool = True
    """Add `reproj_height`: metres above the table, one channel, which LeRobot's own policies do not accept."""
    mask: bool = False
    """Add `reproj_seen`: white where the camera measured a point, black where the image is infilled."""
    cameras: CameraNames = NO_CAMERAS
    """Cameras whose images the view merges, such as `[side, left]`: each cell shows its highest surface, by the camera
    that has the most pixels of it. The view's own camera is always one of them."""
    memory: bool = False
    """Show what is hidden as it was when it was last seen in the episode."""
    age: bool = False
    """Add `reproj_age`: frames since a remembered pixel was last seen, 0 for seen ones, 255 for infilled ones."""

    @property
    def outputs(self) -> dict[str, Kind]:
        """Colour, height above the table, and the mask of measured pixels."""
        outputs: dict[str, Kind] = {"reproj": "rgb"}
        if self.height:
            outputs["reproj_height"] = "height"
        if self.mask:
            outputs["reproj_seen"] = "rgb"
        if self.age:
            outputs["reproj_age"] = "rgb"
        return outputs

    @property
    def needs_depth(self) -> bool:
        """True: the point cloud comes from the depth image."""
        return True

    @property
    def uses_gripper(self) -> bool:
        """True if points are clipped at the gripper's height."""
        return self.clip == "gripper"

    def __post_init__(self) -> None:
        check_size(self.size)
        object.__setattr__(self, "cameras", checked_cameras(self.cameras))  # frozen; JSON has lists
        if self.infill not in INFILLS:
            raise OptionError(f"infill must be one of {', '.join(INFILLS)}, got {self.infill!r}")
        if self.clip not in ("gripper", "none") and (isinstance(self.clip, str) or not self.clip > -math.inf):
            raise OptionError(f"clip must be gripper, none or a height in metres, got {self.clip!r}")
        if not 0 <= self.clip_radius < math.inf:
            raise OptionError(f"clip_radius must be finite metres, at least 0, got {self.clip_radius}")
        if self.clip_radius and self.clip != "gripper":
            raise OptionError(f"clip_radius={self.clip_radius} needs clip=gripper, got {self.clip}")
        if not 0 <= self.flying_limit < math.inf:
            raise OptionError(f"flying_limit must be finite metres, at least 0, got {self.flying_limit}")
        lengths = {"clip_margin": self.clip_margin, "clip_floor": self.clip_floor, "lowest": self.lowest}
        for name, metres in lengths.items():
            if not math.isfinite(metres):
                raise OptionError(f"{name} must be finite metres, got {metres}")
        if self.age and not self.memory:
            raise OptionError("age is that of remembered pixels: it needs memory=true")
        if not isinstance(self.source_scale, Integral) or not 1 <= self.source_scale <= 8:
            raise OptionError(f"source_scale must be an integer from 1 to 8, got {self.source_scale}")

    def without_gripper(self) -> ReprojectedView:
        """Return the view without clipping at the gripper."""
        return replace(self, clip="none", clip_radius=0.0) if self.uses_gripper else self

    def with_mask(self) -> ReprojectedView:
        """Return the view with the output `reproj_seen`."""
        return replace(self, mask=True)

    def start_episode(self) -> Callable[[Frame], dict[str, NDArray]]:
        """Return a function that renders the frames of one episode in order; with `memory`, it remembers them."""
        if not self.memory:
            return self.render
        remembered: list[Memory | None] = [None]

        def render(frame: Frame) -> dict[str, NDArray]:
            images, remembered[0] = self._render(frame, remembered[0])
            return images

        return render

    def render(self, frame: Frame) -> dict[str, NDArray]:
        """Return the outputs; black and height 0 where no point was measured or infilled.

        With `memory`, the frame is the first of an episode.
        """
        return self._render(frame, None)[0]

    def _render(self, frame: Frame, memory: Memory | None) -> tuple[dict[str, NDArray], Memory | None]:
        """Return the outputs and, with the option, the memory of the episode after this frame."""
        from lerobot_symview.geometry import arm, fusion, infill, occlusion, splat, zbuffer  # slow import: numba
        from lerobot_symview.geometry.memory import Memory, recall

        ceiling = self.ceiling(frame.gripper_height)
        sources = [self._source(one) for one in self.merged(frame)]
        depths, cameras = [source.depth for source in sources], [source.camera for source in sources]
        shown_depths, highest = depths, ceiling
        if self.clip_radius and frame.gripper is not None:
            shown_depths = [
                arm.without_arm(depth, camera, frame.workspace, frame.gripper, self.clip_radius, ceiling)
                for depth, camera in zip(depths, cameras, strict=True)
            ]
            highest = np.inf
        buffers = [
            zbuffer.zbuffer_from_depth(depth, camera, frame.workspace, self.size, highest, self.lowest)
            for depth, camera in zip(shown_depths, cameras, strict=True)
        ]
        buffer = buffers[0]
        if len(buffers) > 1:
            buffer = fusion.fuse_buffers(buffers, cameras, frame.workspace)
        seen = buffer.source != zbuffer.EMPTY
        if self.infill == "splat":
            buffer = splat.with_splats(buffer, depths, cameras, frame.workspace)
        colors_of = [source.rgb for source in sources]
        age = None
        if self.memory:
            buffer, age = recall(memory, buffer, depths, cameras, frame.workspace, frame.gripper)
            colors_of += [] if memory is None else [memory.rgb]
        known = buffer.source != zbuffer.EMPTY
        is_nearest = self.infill in ("nearest", "occlusion", "splat")
        shown = infill.nearest_known(known) if is_nearest else _identity_cells(self.size)
        if self.infill in ("occlusion", "splat"):
            for depth, camera in zip(depths, cameras, strict=True):
                shown = occlusion.without_smear(shown, buffer, depth, camera, frame.workspace)
        colors, height = zbuffer.gather(shown, buffer, colors_of)
        remembered = None if age is None else Memory(colors.copy(), height.copy(), age)  # infill changes no known cell
        if self.infill == "local":
            colors, height = infill.fill_local(colors, known), infill.fill_local(height, known)
        images: dict[str, NDArray] = {"reproj": colors, "reproj_height": height}
        if self.mask:
            images["reproj_seen"] = gray_to_rgb(seen.astype(np.uint8) * np.uint8(255))
        if age is not None and self.age:
            images["reproj_age"] = gray_to_rgb(np.where(age < 0, 255, np.minimum(age, 254)).astype(np.uint8))
        return {output: images[output] for output in self.outputs}, remembered

    def _source(self, frame: Frame) -> _Source:
        """Return a frame's images and camera, without flying pixels and upsampled, as the options say."""
        from lerobot_symview.geometry import flying_pixels, upsampling

        if frame.depth is None:
            raise ValueError("the view 'reproj' needs depth; use 'persp' for a camera without depth")
        depth, camera, rgb = frame.depth, frame.camera, frame.rgb
        if self.flying_limit:
            depth = flying_pixels.without_flying_pixels(depth, self.flying_limit)
        if self.source_scale > 1:
            depth, camera = upsampling.enlarge_depth(depth, self.source_scale), _enlarged(camera, self.source_scale)
            rgb = rgb.repeat(self.source_scale, axis=0).repeat(self.source_scale, axis=1)
        return _Source(rgb, depth, camera)

    def ceiling(self, gripper_height: float | None) -> float:
        """Return the height above which points are removed, metres; infinite if the gripper's height is unknown."""
        if self.clip == "gripper":
            return np.inf if gripper_height is None else max(gripper_height - self.clip_margin, self.clip_floor)
        return np.inf if self.clip == "none" else float(self.clip)


@lru_cache(maxsize=64)
def _enlarged(camera: Camera, factor: int) -> Camera:
    return camera.resized(factor * camera.height, factor * camera.width)


@lru_cache(maxsize=8)
def _identity_cells(pixels: int) -> NDArray[np.int32]:
    return np.arange(pixels**2, dtype=np.int32).reshape(pixels, pixels)
