"""Batched views as torch tensors, on any device, bit-identical to rendering the frames one by one.

Every step is a separate operation in float64 or integers, so that no device fuses two steps and rounds differently.
This backend is for GPUs: on a CPU the compiled kernels of `lerobot_symview.geometry` are faster. Maps of lenses are
computed on the CPU, once, and kept on the device.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from lerobot_symview.geometry.camera import Camera, Optics, ideal_pixels
from lerobot_symview.geometry.fusion import SAME_SURFACE
from lerobot_symview.geometry.gripper import gripper_image
from lerobot_symview.geometry.homography import inside_image, pixel_density, warp_map
from lerobot_symview.geometry.visibility import check_above_table
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.geometry.zbuffer import EMPTY, grid_from_pixel
from lerobot_symview.views import PerspectiveView, ReprojectedView, View, check_gripper
from lerobot_symview.views.tracing import is_exporting

SOURCE_BITS = 31  # bits of a sort key for the pixel index; with 32 for the height the key fits a signed int64
FRACTION = 32  # OpenCV's fixed-point steps per pixel
INFILL_BYTES = 2**28  # size of the largest intermediate tensor


@dataclass(frozen=True, eq=False)
class FrameBatch:
    """Frames of equal size, on one device.

    Args:
        rgb: (B, 3, H, W) uint8.
        depth: (B, H, W) float32, metres; invalid values as in `Frame`; None for RGB cameras.
        cameras: B calibrated cameras.
        workspace: the square on the table that the views show.
        gripper: (B, 5) float32, as in `Frame`; None if unknown.
        others: the same frames of further cameras, of any size, by the camera's name.

    Raises:
        ValueError: if the number of cameras is not B, another camera has not B frames of the same workspace, an image's
            size differs from its camera's, or a dtype is wrong.
        CalibrationError: if a camera is below the table.
    """

    rgb: Tensor
    depth: Tensor | None
    cameras: list[Camera]
    workspace: Workspace
    gripper: Tensor | None = None
    others: Mapping[str, FrameBatch] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count, rows, columns = len(self.rgb), *self.rgb.shape[-2:]
        if self.rgb.shape != (count, 3, rows, columns) or self.rgb.dtype != torch.uint8:
            raise ValueError(f"rgb must be (B, 3, H, W) uint8, got {tuple(self.rgb.shape)} {self.rgb.dtype}")
        for camera in self.cameras:
            check_above_table(camera)
        if len(self.cameras) != count:
            raise ValueError(f"{count} frames need {count} cameras, got {len(self.cameras)}")
        if any(len(other.rgb) != count or other.workspace != self.workspace for other in self.others.values()):
            raise ValueError(f"the batches of several cameras must have {count} frames of one workspace")
        sizes = {(camera.height, camera.width) for camera in self.cameras}
        if sizes - {(rows, columns)}:
            raise ValueError(f"rgb has {rows} x {columns} pixels, the cameras have {sorted(sizes)}")
        if self.depth is not None and (
            self.depth.shape != (count, rows, columns) or not self.depth.is_floating_point()
        ):
            raise ValueError(
                f"depth must be {(count, rows, columns)} float metres as rgb, "
                f"got {tuple(self.depth.shape)} {self.depth.dtype}"
            )


def can_batch(view: View) -> bool:
    """Whether `render_batch` supports this view.

    It does for infill `nearest` or `none` and `source_scale` 1, but not with memory or a clip radius, and for no
    third-party views.
    """
    if isinstance(view, ReprojectedView):
        is_simple = view.source_scale == 1 and not view.memory and not view.clip_radius
        return view.infill in ("nearest", "none") and is_simple
    return isinstance(view, PerspectiveView)


def render_batch(view: View, batch: FrameBatch) -> dict[str, Tensor]:
    """Return every output of `view`: (B, 3, size, size) uint8 colour or (B, size, size) float32 metres.

    Raises:
        ValueError: if `can_batch` is False, depth is required and missing, or the gripper's state is not finite.
    """
    if not can_batch(view):
        raise ValueError(f"{view} can be rendered frame by frame only")
    if isinstance(view, ReprojectedView):
        images = _reproject(view, batch)
    else:
        assert isinstance(view, PerspectiveView)
        images = _warp(view, batch)
    return {output: images[output] for output in view.outputs if output in images}


def _reproject(view: ReprojectedView, batch: FrameBatch) -> dict[str, Tensor]:
    ceilings = [view.ceiling(z) for z in _gripper_heights(batch)]
    batches = view.merged(batch)
    buffers = [_zbuffers(view, one, ceilings) for one in batches]
    height, source = buffers[0] if len(buffers) == 1 else _fused(buffers, batches, view.size)
    seen = source != EMPTY
    if view.infill == "nearest":
        nearest = nearest_known_batch(seen).flatten(1)
        height = height.flatten(1).gather(1, nearest).view_as(height)
        source = source.flatten(1).gather(1, nearest).view_as(source)
    known = (source != EMPTY)[:, None]
    pixels = source.clamp(min=0).flatten(1)[:, None].expand(-1, 3, -1)
    rgb = torch.cat([one.rgb.flatten(2) for one in batches], dim=2) if len(batches) > 1 else batch.rgb.flatten(2)
    colors = rgb.gather(2, pixels).view(len(source), 3, view.size, view.size)
    return {
        "reproj": torch.where(known, colors, colors.new_zeros(())),
        "reproj_height": height,
        "reproj_seen": (seen.to(torch.uint8) * 255)[:, None].expand(-1, 3, -1, -1),
    }


def _zbuffers(view: ReprojectedView, batch: FrameBatch, ceilings: list[float]) -> tuple[Tensor, Tensor]:
    if batch.depth is None:
        raise ValueError("the view needs depth")
    depth = without_flying_pixels_batch(batch.depth, view.flying_limit) if view.flying_limit else batch.depth
    return zbuffer_batch(depth, batch.cameras, batch.workspace, view.size, ceilings, view.lowest)


def _fused(
    buffers: Sequence[tuple[Tensor, Tensor]], batches: Sequence[FrameBatch], pixels: int
) -> tuple[Tensor, Tensor]:
    """Return heights and sources of several cameras' z-buffers, as `fuse_buffers` does."""
    height, source = (torch.zeros_like(buffers[0][0]), torch.full_like(buffers[0][1], EMPTY))
    density, first = torch.zeros_like(height), 0
    for (heights, sources), batch in zip(buffers, batches, strict=True):
        densities = _densities(batch, pixels, [0.0] * len(batch.rgb))
        # As the compiled kernel: a float32 difference against a Python number, which is float64.
        rise = (heights - height).double()
        is_better = (rise >= -SAME_SURFACE) & (densities > density)
        taken = (sources != EMPTY) & ((source == EMPTY) | (rise > SAME_SURFACE) | is_better)
        height, density = torch.where(taken, heights, height), torch.where(taken, densities, density)
        source = torch.where(taken, first + sources, source)
        first += batch.rgb.shape[-2] * batch.rgb.shape[-1]
    return height, source


def _densities(batch: FrameBatch, pixels: int, plane_heights: Sequence[float]) -> Tensor:
    """Return the `pixel_density` of each frame's camera, (B, pixels, pixels) float32."""
    planes = zip(batch.cameras, plane_heights, strict=True)
    density = np.stack([pixel_density(camera, batch.workspace, pixels, height) for camera, height in planes])
    return torch.from_numpy(density).to(batch.rgb.device)


def without_flying_pixels_batch(depth: Tensor, limit: float) -> Tensor:
    """Return depth (B, H, W) with 0 at flying pixels, as `without_flying_pixels` does."""
    flying = torch.zeros_like(depth, dtype=torch.bool)
    valid = (depth > 0) & (depth < torch.inf)
    for axis in (1, 2):
        inner = depth.shape[axis] - 2
        if inner < 1:
            continue
        before, here, after = (depth.narrow(axis, start, inner).double() for start in (0, 1, 2))
        known = valid.narrow(axis, 0, inner) & valid.narrow(axis, 2, inner)
        rising = (here - before > limit) & (after - here > limit)
        falling = (before - here > limit) & (here - after > limit)
        flying.narrow(axis, 1, inner).logical_or_(known & (rising | falling))
    return torch.where(flying, torch.zeros_like(depth), depth)


def zbuffer_batch(
    depth: Tensor, cameras: list[Camera], workspace: Workspace, pixels: int, ceilings: list[float], floor: float
) -> tuple[Tensor, Tensor]:
    """Render each depth image into its own top-down z-buffer, as `zbuffer_from_depth` does.

    Args:
        depth: (B, H, W) float32, metres.
        cameras: B calibrated cameras.
        workspace: the square on the table that the buffers cover.
        pixels: P, rows and columns of a buffer.
        ceilings: B heights, metres, above which points are ignored.
        floor: height, metres, below which points are ignored.

    Returns:
        heights (B, P, P) float32 and sources (B, P, P) int64.
    """
    count, rows, columns = depth.shape
    matrices = [grid_from_pixel(camera, workspace, pixels) for camera in cameras]
    rays, origin, ceiling = (
        torch.from_numpy(np.array(values)).to(depth.device)
        for values in ([ray for ray, _ in matrices], [start for _, start in matrices], ceilings)
    )
    u, v = ideal_pixels_batch(cameras, depth.device)
    distance = depth.double()
    rays, origin = rays[..., None, None], origin[..., None, None]  # (B, 3, 3, 1, 1) and (B, 3, 1, 1)
    row, column, z = (
        origin[:, axis] + distance * (rays[:, axis, 0] * u + (rays[:, axis, 1] * v + rays[:, axis, 2]))
        for axis in range(3)
    )
    valid = (distance > 0) & (distance < torch.inf) & (z <= ceiling[:, None, None]) & (z >= floor)
    valid &= (row >= 0) & (column >= 0) & (row < pixels) & (column < pixels)
    cell = torch.where(valid, row, 0.0).long() * pixels + torch.where(valid, column, 0.0).long()
    heights = torch.where(valid, z, 0.0).float()
    # The key orders by height, then by lowest source, so that the maximum of a cell does not depend on the write order.
    index = torch.arange(rows * columns, device=depth.device).view(rows, columns)
    key = (_ordered(heights) << SOURCE_BITS) | (2**SOURCE_BITS - 1 - index)
    best = torch.zeros(count, pixels * pixels + 1, dtype=torch.int64, device=depth.device)
    target = torch.where(valid, cell, pixels * pixels).flatten(1)  # the last cell collects the ignored points
    best = best.scatter_reduce(1, target, key.flatten(1), "amax")[:, :-1].view(count, pixels, pixels)
    source = torch.where(best > 0, 2**SOURCE_BITS - 1 - (best & (2**SOURCE_BITS - 1)), EMPTY)
    height = heights.flatten(1).gather(1, source.clamp(min=0).flatten(1)).view_as(source)
    return torch.where(source == EMPTY, torch.zeros_like(height), height), source


def ideal_pixels_batch(cameras: list[Camera], device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the ideal pixels, u and v, of B cameras with images of one size; they broadcast to (B, H, W)."""
    if len({camera.optics for camera in cameras}) == 1 or all(camera.lens is None for camera in cameras):
        return _ideal_pixels_on(device, cameras[0].optics)
    size = (cameras[0].height, cameras[0].width)
    maps = [[plane.expand(size) for plane in _ideal_pixels_on(device, camera.optics)] for camera in cameras]
    u, v = (torch.stack(planes) for planes in zip(*maps, strict=True))
    return u, v


def _ideal_pixels_on(device: torch.device, optics: Optics) -> tuple[Tensor, Tensor]:
    if is_exporting():
        return _copy_ideal_pixels(device, optics)  # a recorded tensor is of no use outside of its recording
    return _cached_ideal_pixels(device, optics)


def _copy_ideal_pixels(device: torch.device, optics: Optics) -> tuple[Tensor, Tensor]:
    u, v = (torch.from_numpy(np.array(plane)).to(device) for plane in ideal_pixels(optics))
    return u, v


_cached_ideal_pixels = lru_cache(maxsize=8)(_copy_ideal_pixels)


def _ordered(values: Tensor) -> Tensor:
    """Map float32 to integers in (0, 2^32) with the same order."""
    bits = (values + 0.0).view(torch.int32).long() & 0xFFFFFFFF  # adding 0 turns -0 into +0
    return torch.where(bits >> 31 == 1, 0xFFFFFFFF - bits, bits | (1 << 31))


def nearest_known_batch(known: Tensor) -> Tensor:
    """Find nearest known pixels as `nearest_known` does: (B, H, W) bool to (B, H, W) int64; 0 if none is known."""
    count, rows, columns = known.shape
    nowhere = 4 * (rows + columns)
    r = torch.arange(rows, device=known.device)[:, None]
    above = torch.where(known, r, -nowhere).cummax(1).values
    below = torch.where(known, r, nowhere + rows).flip(1).cummin(1).values.flip(1)
    row_of = torch.where(r - above <= below - r, above, below)
    step = (row_of - r) ** 2
    c = torch.arange(columns, device=known.device)
    across = (c[:, None] - c) ** 2
    best_column = torch.empty_like(row_of)
    chunk = max(1, INFILL_BYTES // (8 * count * columns * columns))
    for first in range(0, rows, chunk):
        # [b, r, c, j]: squared distance from (r, c) to the nearest pixel of column j, then j itself, which breaks ties
        distance = (step[:, first : first + chunk, None, :] + across) * columns + c
        best_column[:, first : first + chunk] = distance.amin(-1) % columns
    best_row = row_of.gather(2, best_column)
    return torch.where(known.flatten(1).any(1)[:, None, None], best_row * columns + best_column, 0)


def _warp(view: PerspectiveView, batch: FrameBatch) -> dict[str, Tensor]:
    heights = [view.plane(z) for z in _gripper_heights(batch)]
    images = {"persp": _warped(view, batch, heights)}
    if view.gripper and batch.gripper is not None:
        drawn = gripper_image(batch.gripper.double(), batch.workspace, view.size)
        grey = torch.round(255 * drawn.clamp(0.0, 1.0)).to(torch.uint8)
        images["persp_gripper"] = grey[:, None].expand(-1, 3, -1, -1)
    return images


def _warped(view: PerspectiveView, batch: FrameBatch, heights: list[float]) -> Tensor:
    """Return the warped images (B, 3, size, size) uint8; of several cameras, by the best at each pixel."""
    batches = view.merged(batch)
    images = [_warped_alone(view, one, heights) for one in batches]
    if len(images) == 1:
        return images[0][0]
    shown = [
        inside & (one.rgb > 0).flatten(1).any(1)[:, None, None]
        for one, (_, inside) in zip(batches, images, strict=True)
    ]
    density = [
        torch.where(mask, _densities(one, view.size, heights), -1.0) for one, mask in zip(batches, shown, strict=True)
    ]
    best = torch.stack(density).argmax(0)[None, :, None].expand(-1, -1, 3, -1, -1)
    return torch.stack([image for image, _ in images]).gather(0, best)[0]


def _warped_alone(view: PerspectiveView, batch: FrameBatch, heights: list[float]) -> tuple[Tensor, Tensor]:
    """Return one camera's warped images (B, 3, size, size) uint8, and where they are inside its image."""
    maps = [
        warp_map(camera, batch.workspace, view.size, height)
        for camera, height in zip(batch.cameras, heights, strict=True)
    ]
    device = batch.rgb.device
    whole = torch.from_numpy(np.stack([warp.whole for warp in maps])).to(device).long()
    fraction = torch.from_numpy(np.stack([warp.fraction for warp in maps]).astype(np.int64)).to(device)
    right, down = fraction % FRACTION, fraction // FRACTION
    rows, columns = batch.rgb.shape[2:]
    total = torch.zeros(len(maps), 3, view.size, view.size, dtype=torch.int64, device=device)
    for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
        x, y = whole[..., 0] + dx, whole[..., 1] + dy
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        index = torch.where(inside, y * columns + x, 0).flatten(1)[:, None].expand(-1, 3, -1)
        color = batch.rgb.flatten(2).gather(2, index).view_as(total).long()
        weight = (right if dx else FRACTION - right) * (down if dy else FRACTION - down)
        total += torch.where(inside, weight, 0)[:, None] * color
    in_image = np.stack([inside_image(warp, camera) for warp, camera in zip(maps, batch.cameras, strict=True)])
    return ((total + FRACTION**2 // 2) // FRACTION**2).to(torch.uint8), torch.from_numpy(in_image).to(device)


def _gripper_heights(batch: FrameBatch) -> list[float | None]:
    if batch.gripper is None:
        return [None] * len(batch.rgb)
    states = batch.gripper.tolist()
    for state in states:  # here, where .tolist() has synchronised with the GPU
        check_gripper(state)
    return [z for _, _, z, *_ in states]
