"""Suite `views`: time of a view relative to OpenCV's warp of the same image, and of `symview-add-views` end to end."""

from __future__ import annotations

import shutil
import statistics
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_symview import keys
from lerobot_symview.datasets import view_derivation
from lerobot_symview.datasets.add_views import AddViewsConfig, add_views
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.datasets.image_codec import decode_rgb, encode_rgb
from lerobot_symview.datasets.source import SourceDataset
from lerobot_symview.geometry.camera import Camera, DepthSensor, aligned_depth
from lerobot_symview.geometry.homography import image_from_topdown
from lerobot_symview.geometry.lens import PLUMB_BOB, Lens
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.geometry.visibility import table_rays
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import Frame, View, ViewSpec, make_view
from symview_eval.benchmarks.clock import Clock, seconds
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import EnvSettings, NewDataset

BATCH = 64  # frames on a GPU
NOISE = 2.0  # standard deviation in levels of 255: a webcam indoors
WEBCAM = Lens(PLUMB_BOB, (-0.27, 0.05, 0.001, 0.0, 0.0))  # ordinary barrel distortion
BASELINE = np.array([[1, 0, 0, 0.015], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # a RealSense's color_from_depth
RECORDED = 25  # recorded episodes, repeated to fill the offline dataset
VIEWS: dict[str, tuple[str, dict[str, Any]]] = {
    "reproject_nearest": ("reproj", {}),
    "reproject_none": ("reproj", {"infill": "none"}),
    "reproject_occlusion": ("reproj", {"infill": "occlusion"}),
    "reproject_splat": ("reproj", {"infill": "splat"}),
    "reproject_local": ("reproj", {"infill": "local"}),
    "reproject_scale_2": ("reproj", {"source_scale": 2}),
    "perspective": ("persp", {"gripper": False}),
    "perspective_with_gripper": ("persp", {}),
}
CODECS = (
    (SourceDataset, "decode"),
    (view_derivation, "encode_rgb"),
    (view_derivation, "encode_metres"),
    (view_derivation, "image_column"),
    (pq.ParquetFile, "read_row_groups"),
    (pq.ParquetWriter, "write_table"),
)


@dataclass(frozen=True)
class ViewsBenchmark:
    """Measure views of 152 x 152 pixels on one core, and `symview-add-views`."""

    repeats: int = 300
    """Renderings of each view; each is timed together with one OpenCV warp, and the ratio is reported."""
    frames: int = 10_000
    """Frames of the dataset to which views are added; 0 skips this part. A second process takes seconds to start."""
    rounds: int = 3
    """Times that views are added to the whole dataset, by one process and by two."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def __post_init__(self) -> None:
        for name in ("repeats", "rounds"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} must be at least 1, got {getattr(self, name)}")
        if self.frames < 0:
            raise ValueError(f"--frames must not be negative, got {self.frames}")


def benchmark_views(config: ViewsBenchmark) -> dict[str, float]:
    """Time the views.

    Returns:
        Medians, with the quartiles as `_low` and `_high`. `*_ratio`: a view's time over that of `cv2.warpPerspective`.
        `floor_ratio`: time to copy the bytes that a reprojection reads and writes, over the same. `vga_ms`,
        `vga_lens_ms`, `vga_unaligned_ms` and `hd_ms`: a frame of 640 x 480 pixels reprojected, the same with a lens,
        the same with depth from a sensor of its own, and a frame of 1280 x 720. `vga_lens_ratio` and
        `vga_unaligned_ratio`: the second and third over the first; the aim is 2. `fused_ms` and `fused_ratio`: two
        frames of 640 x 480 in one view, and over one; the aim is 2.2. `batched_*`, on a GPU: time per frame of a batch,
        without quartiles. `offline_codec_share`: part of `symview-add-views` spent on reading, decoding,
        encoding and writing, for images with a real camera's noise. `offline_two_process_speedup`: speed-up by a second
        process including its start-up, most of which falls into the first round. `frames_per_s`: frames for which one
        process makes both views.
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        results = _ratios(simulated_frame(), config.repeats) | real_camera_times(config.repeats)
    finally:
        cv2.setNumThreads(threads)
    results |= _on_a_gpu(config.repeats)
    return results | (_offline(config.frames, config.rounds) if config.frames else {})


def _on_a_gpu(repeats: int) -> dict[str, float]:
    import torch  # imported here: worker processes import this module, and torch takes longer than their work

    return batched_ratios(simulated_frame(), repeats, "cuda") if torch.cuda.is_available() else {}


def batched_ratios(frame: Frame, repeats: int, device: str) -> dict[str, float]:
    """Return the time per frame of a batch of 64 on `device`, in microseconds and over that of copying its bytes."""
    import torch

    from lerobot_symview.views.torch_backend import FrameBatch, render_batch

    def synchronize() -> None:
        if device == "cuda":
            torch.cuda.synchronize()

    assert frame.depth is not None
    rgb = torch.from_numpy(frame.rgb.copy()).permute(2, 0, 1)[None].expand(BATCH, -1, -1, -1).contiguous()
    depth = torch.from_numpy(frame.depth.copy())[None].expand(BATCH, -1, -1).contiguous()
    gripper = torch.as_tensor(frame.gripper)[None].expand(BATCH, -1)
    cameras = [frame.camera] * BATCH
    batch = FrameBatch(rgb.to(device), depth.to(device), cameras, frame.workspace, gripper.to(device))
    source = torch.empty(BATCH * _bytes_moved(frame), dtype=torch.uint8, device=device)
    target = torch.empty_like(source)

    def finished(call: Callable[[], object]) -> float:
        def whole() -> None:
            call()
            synchronize()

        synchronize()
        return seconds(whole)

    results = {}
    for name in ("reproject_nearest", "reproject_none", "perspective"):
        view_name, options = VIEWS[name]
        view = make_view(view_name, **options)
        render = partial(render_batch, view, batch)
        render()
        times = [(finished(render), finished(lambda: target.copy_(source))) for _ in range(repeats)]
        results[f"batched_{name}_us"] = 1e6 * statistics.median(render_s for render_s, _ in times) / BATCH
        results[f"batched_{name}_copy_ratio"] = statistics.median(render_s / copy_s for render_s, copy_s in times)
    return results


def _bytes_moved(frame: Frame) -> int:
    """Return the bytes that a reprojection reads and writes."""
    assert frame.depth is not None
    return frame.rgb.nbytes + frame.depth.nbytes + make_view("reproj").size ** 2 * 7  # colour and float height


def simulated_frame() -> Frame:
    """Return the first frame of an episode of block picking."""
    env = EnvSettings().make()
    observation, _ = env.reset(seed=0)
    camera = env.cameras["side"]
    rgb, depth = observation["pixels"]["side"], observation["images.side_depth"][0]
    frame = Frame(rgb, depth, camera, env.workspace, observation["agent_pos"])
    env.close()
    return frame


def _ratios(frame: Frame, repeats: int) -> dict[str, float]:
    assert frame.depth is not None
    size = make_view("persp").size
    homography = image_from_topdown(frame.camera, frame.workspace, size)

    def warp() -> None:
        cv2.warpPerspective(frame.rgb, homography, (size, size), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)

    source = np.empty(_bytes_moved(frame), dtype=np.uint8)
    target = np.empty_like(source)
    candidates: dict[str, Callable[[], object]] = {"floor": lambda: np.copyto(target, source)}
    for name, (view_name, options) in VIEWS.items():
        view = make_view(view_name, **options)
        candidates[name] = lambda view=view: view.render(frame)  # type: ignore[misc]
    warps: list[float] = []
    results: dict[str, float] = {}
    for name, candidate in candidates.items():
        candidate()
        warp()
        ratios = []
        for _ in range(repeats):
            reference = seconds(warp)
            warps.append(reference)
            ratios.append(seconds(candidate) / reference)
        results |= _median_and_quartiles(f"{name}_ratio", ratios)
    return {"warp_us": 1e6 * statistics.median(warps)} | results


def real_camera_times(repeats: int) -> dict[str, float]:
    """Return the milliseconds of reprojections of the table from images of real cameras, and ratios to `vga_ms`."""
    view, workspace = make_view("reproj", clip="none", cameras=("left",)), Workspace()
    vga, hd = (CameraSpec(height=rows, width=columns).place(workspace) for rows, columns in ((480, 640), (720, 1280)))
    frames = {
        "vga": _table_frame(vga, workspace),
        "vga_lens": _table_frame(replace(vga, lens=WEBCAM), workspace),
        "hd": _table_frame(hd, workspace),
    }
    sensor = DepthSensor(vga.intrinsics * [[0.8], [0.8], [1]] + [[0, 0, 64], [0, 0, 48], [0, 0, 0]], BASELINE)
    unaligned = replace(vga, depth_sensor=sensor)
    _, depth, _ = table_rays(unaligned.depth_camera(480, 640), workspace)
    depth, rgb = depth.astype(np.float32), frames["vga"].rgb

    def render_unaligned() -> object:
        return view.render(Frame(rgb, aligned_depth(depth, unaligned), unaligned, workspace))

    calls: dict[str, Callable[[], object]] = {name: partial(view.render, frame) for name, frame in frames.items()}
    calls["vga_unaligned"] = render_unaligned
    other = _table_frame(CameraSpec(height=480, width=640, azimuth_deg=90.0).place(workspace), workspace)
    calls |= {"episode": _episode(view, frames["vga"]), "memory": _episode(replace(view, memory=True), frames["vga"])}
    calls["splat"] = partial(replace(view, infill="splat").render, frames["vga"])
    calls["fused"] = partial(view.render, replace(frames["vga"], others={"left": other}))
    for call in calls.values():
        call()
    rounds = [{name: 1000 * seconds(call) for name, call in calls.items()} for _ in range(repeats)]
    results: dict[str, float] = {}
    for name in calls:
        results |= _median_and_quartiles(f"{name}_ms", [times[name] for times in rounds])
    for name in ("vga_lens", "vga_unaligned", "fused", "splat"):
        results |= _median_and_quartiles(f"{name}_ratio", [times[name] / times["vga"] for times in rounds])
    results |= _median_and_quartiles("memory_ratio", [times["memory"] / times["episode"] for times in rounds])
    return results


def _episode(view: View, frame: Frame) -> Callable[[], object]:
    """Return a call that renders 16 frames of an episode; in all but the first, a third of the image is hidden."""
    assert frame.depth is not None
    hidden = frame.depth.copy()
    hidden[:, : frame.camera.width // 3] = 0.3
    later = replace(frame, depth=hidden)

    def call() -> object:
        render = view.start_episode()
        return [render(each) for each in [frame] + [later] * 15]

    return call


def _table_frame(camera: Camera, workspace: Workspace) -> Frame:
    """Return the frame of an empty table, with random colours."""
    _, depth, _ = table_rays(camera, workspace)
    rgb = np.random.default_rng(0).integers(0, 256, (*depth.shape, 3), dtype=np.uint8)
    return Frame(rgb, depth.astype(np.float32), camera, workspace)


def _median_and_quartiles(name: str, values: list[float]) -> dict[str, float]:
    # inclusive: no quartile lies outside of the measured values
    low, median, high = statistics.quantiles(values, n=4, method="inclusive") if len(values) > 1 else values * 3
    return {name: median, f"{name}_low": low, f"{name}_high": high}


def _offline(frames: int, rounds: int) -> dict[str, float]:
    names = ("offline_codec_share", "offline_two_process_speedup", "frames_per_s")
    values: dict[str, list[float]] = {name: [] for name in names}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        recorded, source = _repeated_dataset(folder, frames)
        total = SourceDataset(source).info["total_frames"]

        def add(dataset: Path, num_workers: int = 1) -> float:
            target = folder / "views"
            config = AddViewsConfig(
                HubDataset("benchmark/source", dataset),
                new_root=target,
                views=[ViewSpec("reproj"), ViewSpec("persp")],
                num_workers=num_workers,
            )
            taken = seconds(lambda: add_views(config))
            shutil.rmtree(target)
            return taken

        add(recorded)  # imports and compiled kernels are loaded before the clocks start
        for _ in range(rounds):
            with _codec_clocks() as clocks:
                alone = add(source)
            values["offline_codec_share"].append(sum(clock.milliseconds for clock in clocks) / 1000 / alone)
            values["offline_two_process_speedup"].append(alone / add(source, num_workers=2))
            values["frames_per_s"].append(total / alone)
    return {key: value for name in names for key, value in _median_and_quartiles(name, values[name]).items()}


def _repeated_dataset(folder: Path, frames: int) -> tuple[Path, Path]:
    """Return a recorded dataset with a real camera's noise, and one that repeats it to at least `frames` frames."""
    from lerobot.datasets import aggregate_datasets

    target = NewDataset("benchmark/recorded", folder / "recorded")
    recorded = generate(GenerateConfig(target, env=RecordedEnv(oracle=False), num_episodes=RECORDED))
    for file in sorted((recorded / "data").rglob("*.parquet")):
        _add_noise(file, keys.rgb("side"))
    repeats = -(-frames // SourceDataset(recorded).info["total_frames"])
    if repeats == 1:
        return recorded, recorded
    aggregate_datasets(
        [target.repo_id] * repeats,
        "benchmark/source",
        roots=[recorded] * repeats,
        aggr_root=folder / "source",
        concatenate_data=False,
    )
    return recorded, folder / "source"


def _add_noise(file: Path, key: str) -> None:
    """Add noise to a table's colour images, which makes them as hard to compress as a real camera's."""
    table, rng = pq.read_table(file), np.random.default_rng(0)
    cells = table[key].to_pylist()
    for cell in cells:
        image = decode_rgb(cell["bytes"])
        noisy = image + rng.normal(0.0, NOISE, image.shape)
        cell["bytes"] = encode_rgb(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    column = table.schema.get_field_index(key)
    pq.write_table(table.set_column(column, table.field(column), pa.array(cells, table.field(column).type)), file)


@contextmanager
def _codec_clocks() -> Iterator[list[Clock]]:
    clocks = [Clock(owner, name) for owner, name in CODECS]
    try:
        yield clocks
    finally:
        for clock in clocks:
            clock.remove()
