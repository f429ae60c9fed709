"""`symview-preview`: shows the camera's images and the views of a dataset, before or after the views are added."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lerobot_symview import keys
from lerobot_symview.calibration.readings import PoseReading
from lerobot_symview.datasets.add_views import (
    POSE_FLAGS,
    calibration_and_workspace,
    unit_from_flag,
    views_for_dataset,
)
from lerobot_symview.datasets.calibration_check import check_calibration, with_depth_units
from lerobot_symview.datasets.features import Features, is_depth_feature
from lerobot_symview.datasets.frame_reader import FrameReader
from lerobot_symview.datasets.source import EpisodeTables, SourceDataset
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.state_reader import StateOrigin
from lerobot_symview.geometry.visibility import MILLIMETRE, MINIMUM_VISIBLE, table_resolution
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import CommandError, DatasetLocation, flagged, run_command
from lerobot_symview.runtime.view_flags import views_from_flags
from lerobot_symview.views import Frame, PerspectiveView, ReprojectedView, View, ViewSpec
from symview_eval.calibrate.photographs import from_files
from symview_eval.contact_sheet import SheetRow, grey, montage, page, with_outline
from symview_eval.drift_check import check_drift, check_image
from symview_eval.gripper_path import GripperPath, read_path
from symview_eval.live_camera import device_of, take_images, with_device
from symview_eval.rerun_recording import RerunRecording

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-preview --dataset.repo_id=me/picking
  symview-preview --dataset.repo_id=me/real --calibration=cameras.yaml --camera=front --episodes='[0, 7]' \\
      --reproj.source_scale=2 --output_dir=preview
  symview-preview --dataset.repo_id=me/real --camera=front --check=true
  symview-preview --dataset.repo_id=me/real --camera=front --check_image=now.png
  symview-preview --dataset.repo_id=me/real --camera=front --check=true --device.type=opencv --device.index_or_path=0"""
LEAST_DETAIL = 0.2  # the camera's pixels per millimetre at worst, relative to the view's; in the paper's setup, 0.29
SMALLEST_TRAINED = 76  # pixels of a view that a policy takes, with a crop of 64


@dataclass(frozen=True)
class PreviewConfig:
    """Show frames of a dataset: the camera's image with the workspace and the gripper's path, the views, their masks.

    Writes a contact sheet (preview.png, preview.html) and, with rerun, preview.rrd. Warns about a camera that sees too
    little of the workspace, views with many inferred pixels, a camera whose resolution is too low for the views, and
    demonstrations that contradict the declared symmetry of states and actions.
    """

    dataset: DatasetLocation
    """The dataset."""
    episodes: list[int] = field(default_factory=lambda: [0])
    """Episodes to show."""
    frames: int = 4
    """Frames per episode, evenly spaced in time."""
    camera: str = "side"
    """Camera that views are made from; a dataset that holds only views is shown as it is."""
    views: list[ViewSpec] | None = None
    """Which views to compute; by default those that the dataset does not store and has the images for, and those whose
    options are stated. Stored ones are shown as they are.
    """
    size: int | None = None
    """Rows and columns of all views; by default each view's own."""
    reproj: ReprojectedView = field(default_factory=ReprojectedView)
    """Options of the view reproj."""
    persp: PerspectiveView = field(default_factory=PerspectiveView)
    """Options of the view persp."""
    calibration: Path | list[Path] | None = None
    """File with the camera's calibration, for a dataset without one, or files that complete each other:
    `[camera_info.yaml, handeye.calib]`; see docs/calibration_formats.md."""
    pose: PoseReading = field(default_factory=PoseReading)
    """How to read the calibration's pose; by default as its file says, else as the reading that sees the workspace."""
    depth_unit: str | None = None
    """Unit of the cameras' depth: m, mm, or metres per unit, such as 0.0001 (RealSense D405) or 0.00025 (L515); by
    default that of the calibration file, else of the dataset, else the one that shows the table at z = 0."""
    workspace: Workspace | None = None
    """Square of the table that the views show, such as `--workspace.center='[0.5, 0.1]' --workspace.size=0.5`; by
    default that of the calibration file, else the dataset's, else the simulator's. The gripper's x and y are relative
    to its centre.
    """
    state_origin: StateOrigin | None = None
    """What the positions in the state count from: workspace, world or base; as for symview-add-views."""
    state_symmetry: list[str] | None = None
    """Types of the state's dimensions, as for --policy.state_symmetry; by default those that its names say."""
    action_symmetry: list[str] | None = None
    """Types of the action's dimensions, as for --policy.action_symmetry; by default those that its names say."""
    check: bool = False
    """Compare the first frames of all episodes: warn if the camera was moved between them, and write `cameras.yaml`,
    the camera as it stands in the last of them. With the flags of `--device.type`, a camera that LeRobot knows, compare
    an image that it takes now."""
    check_image: Path | None = None
    """An image that the camera takes now, such as one of `lerobot-find-cameras`: warn if the camera was moved since its
    calibration, and write `cameras.yaml`."""
    max_holes: float = 0.85
    """Fraction of a reprojected view's pixels that may be inferred before a warning is given; at 45 degrees, an image
    of the view's own size leaves three quarters, as in the paper's setup."""
    rerun: bool = field(default_factory=lambda: find_spec("rerun") is not None)
    """Write preview.rrd; by default if rerun is installed."""
    output_dir: Path = Path("preview")
    """Folder for the files."""

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise ValueError(f"--frames must be at least 1, got {self.frames}")
        if not self.episodes:
            raise ValueError("--episodes is empty: give at least one, such as --episodes='[0]'")
        if self.check and self.check_image is not None:
            raise ValueError("--check and --check_image both write cameras.yaml: give one of them")
        if device_of(self) is not None and not self.check:
            raise ValueError("--device takes an image to compare with the dataset: give --check=true beside it")
        if self.check_image is not None and not self.check_image.expanduser().is_file():
            raise ValueError(f"--check_image must be an image file, got {self.check_image}")
        if not 0 <= self.max_holes <= 1:
            raise ValueError(f"--max_holes must lie in [0, 1], got {self.max_holes}")
        unit_from_flag(self.depth_unit)


@dataclass(frozen=True)
class FrameSample:
    """One frame of a dataset and its stored images."""

    episode: int
    index: int
    frame: Frame | None
    """Input of the views; None for a dataset that stores only views."""
    stored: dict[str, NDArray]
    """Stored images by name: colour (H, W, 3) uint8, or depth or height (H, W) in metres."""

    @property
    def title(self) -> str:
        """Episode and frame number."""
        return f"episode {self.episode}, frame {self.index}"


def read_samples(
    source: SourceDataset, reader: FrameReader | None, episode: int, indices: Iterable[int]
) -> list[FrameSample]:
    """Return the frames `indices` of an episode; without a reader, only their stored images."""
    table = EpisodeTables(source, source.data_file(episode)).read(episode)
    images = [key for key, feature in source.features.items() if feature["dtype"] in ("image", "video")]
    samples = []
    for index in indices:
        row = table.slice(index, 1)
        stored = {key.removeprefix(keys.IMAGES): next(source.images(key, episode, row)) for key in images}
        samples.append(FrameSample(episode, index, next(reader.frames(episode, row)) if reader else None, stored))
    return samples


@dataclass(frozen=True)
class Measures:
    """Measurements of one frame."""

    visible: float
    """Fraction of the working volume that lies in the camera's image."""
    resolution: float
    """Lowest resolution of the camera on the table, pixels per millimetre."""
    holes: dict[str, float]
    """Fraction of inferred pixels, of each view that has a mask."""


def preview(config: PreviewConfig) -> Path:
    """Write the contact sheet and the recording, and return their folder.

    Raises:
        CommandError: if the dataset has no such episode.
        ValueError: if it has no such camera.
        CalibrationError: if the images contradict the calibration; the contact sheet is written nevertheless, unless
            the camera is below the table.
    """
    with flagged("--dataset"):
        source = SourceDataset(config.dataset.folder())
    total = len(source.episodes)
    unknown = [episode for episode in config.episodes if not 0 <= episode < total]
    if unknown:
        raise CommandError(f"--episodes names {unknown}, the dataset has {total} episodes, from 0 to {total - 1}")
    reader, views = _chosen(config, source)
    if (config.check or config.check_image) and reader is None:
        raise ValueError("--check, --check_image and --device need the camera's images: the dataset has views only")
    from symview_eval.declaration import check_declaration  # imports LeRobot, which takes seconds

    declaration = check_declaration(source, reader, config.state_symmetry, config.action_symmetry)
    config.output_dir.mkdir(parents=True, exist_ok=True)
    recording = None
    if config.rerun and reader is not None:
        recording = RerunRecording(config.output_dir / "preview.rrd", reader.workspace)
    rows, measured = [], []
    for episode in tqdm(config.episodes, desc="preview", unit="episode"):
        length = source.episodes[episode]["length"]
        indices = np.unique(np.linspace(0, length - 1, config.frames).round().astype(int)).tolist()
        renderers = [view.with_mask().start_episode() for view in views.values()]
        path = read_path(reader, episode) if reader is not None else None
        needed = range(indices[-1] + 1) if any(view.memory for view in views.values()) else indices
        for sample in read_samples(source, reader, episode, needed):
            if sample.frame is None or reader is None:
                shown = {name: _displayable(image) for name, image in sample.stored.items()}
                rows.append(SheetRow(sample.title, [], shown))
                continue
            made = _render(sample.frame, config.camera, renderers)
            if sample.index not in indices:
                continue
            measures = _measure(sample.frame.camera, reader.workspace, made)
            rows.append(_row(config.camera, sample, sample.frame, made, measures, path))
            measured.append(measures)
            if recording is not None:
                stored = {name: sample.stored[name] for name in _stored_views(source.features)}
                recording.add(len(rows) - 1, config.camera, sample.frame, stored | made)
    if recording is not None:
        recording.close()
    warnings = _warnings(config, views, reader.workspace, measured) if reader is not None else []
    warnings += declaration.warnings
    for warning in warnings:
        logger.warning("%s", warning)
    montage(rows).save(config.output_dir / "preview.png")
    (config.output_dir / "preview.html").write_text(page(config.dataset.repo_id, rows, warnings, declaration.facts))
    for fact in declaration.facts:
        logger.info("declared symmetry: %s", fact)
    logger.info("wrote %s", ", ".join(str(file) for file in sorted(config.output_dir.glob("preview.*"))))
    if reader is not None:
        _check_camera(config, reader)
        with flagged(f"--camera={config.camera}, --calibration, --depth_unit"):
            check_calibration(reader)
    return config.output_dir


def _check_camera(config: PreviewConfig, reader: FrameReader) -> None:
    """Report whether the camera was moved, as far as the flags ask for it."""
    device = device_of(config)
    if config.check_image is not None:
        with flagged("--check_image"):
            ((name, image),) = from_files(str(config.check_image)).items()
            check_image(reader, name, image, config.output_dir)
    elif device is not None:
        (image,) = take_images(device)
        height, width, _ = reader.dataset.features[keys.rgb(config.camera)]["shape"]
        if image.shape[:2] != (height, width):
            raise CommandError(
                f"--device took an image of {image.shape[1]} x {image.shape[0]} pixels, those of camera "
                f"{config.camera!r} have {width} x {height}: give --device.width={width} --device.height={height}"
            )
        with flagged("--device"):
            check_image(reader, "the live image", image, config.output_dir)
    elif config.check:
        check_drift(reader, config.output_dir)


def _chosen(config: PreviewConfig, source: SourceDataset) -> tuple[FrameReader | None, dict[str, View]]:
    """Return the reader of the camera's frames, None for a dataset of views alone, and the views to make."""
    if keys.rgb(config.camera) not in source.features:
        if config.views is None and config.calibration is None:
            return None, {}
        raise ValueError(f"the dataset has no camera {config.camera!r}: check --camera")
    calibration, workspace = calibration_and_workspace(
        config.calibration, config.workspace, source.features, config.camera, config.pose
    )
    options: dict[str, View] = {"reproj": config.reproj, "persp": config.persp}
    specs = config.views
    if specs is None:
        specs = [ViewSpec(name) for name, view in options.items() if _is_wanted(config, view, source.features)]
    views = views_from_flags(specs, config.size, options) if specs else {}
    views = views_for_dataset(views, source.features)
    read_for = [*views.values()]
    if config.rerun and is_depth_feature(source.features.get(keys.depth(config.camera), {})):
        read_for.append(ReprojectedView(clip="none"))  # a recording has the point cloud even if no view needs it
    reader = FrameReader(source, config.camera, workspace, read_for, calibration, state_origin=config.state_origin)
    with flagged(f"--camera={config.camera}, --calibration"):
        reader.check()
        reader = with_depth_units(reader, unit_from_flag(config.depth_unit))
    return reader, views


def _is_wanted(config: PreviewConfig, view: View, features: Features) -> bool:
    """Whether to compute a view that --views does not name.

    The dataset has its inputs, and either it lacks the view or a flag changes the view, its camera or its workspace.
    """
    if view.needs_depth and keys.depth(config.camera) not in features:
        return False
    settings = (config.size, config.calibration, config.workspace)
    has_options = any(setting is not None for setting in settings) or view != type(view)()
    return has_options or not any(keys.view(config.camera, output) in features for output in view.outputs)


def _stored_views(features: Features) -> list[str]:
    """Return the names of the stored images that are views."""
    facts = {key: (feature.get("info") or {}).get("symview", {}) for key, feature in features.items()}
    return [key.removeprefix(keys.IMAGES) for key, fact in facts.items() if "view" in fact]


def _render(frame: Frame, camera: str, renderers: list[Callable[[Frame], dict[str, NDArray]]]) -> dict[str, NDArray]:
    """Return every output of the views by name."""
    images: dict[str, NDArray] = {}
    for render in renderers:
        images |= render(frame)
    return {f"{camera}_{output}": image for output, image in images.items()}


def _measure(camera: Camera, workspace: Workspace, made: dict[str, NDArray]) -> Measures:
    masks = {name.removesuffix("_seen"): image for name, image in made.items() if name.endswith("_seen")}
    holes = {name: 1.0 - float((mask > 0).mean()) for name, mask in masks.items()}
    return Measures(workspace.visible_fraction(camera), table_resolution(camera, workspace), holes)


def _row(
    name: str,
    sample: FrameSample,
    frame: Frame,
    made: dict[str, NDArray],
    measures: Measures,
    path: GripperPath | None,
) -> SheetRow:
    offset = frame.camera.position - [*frame.workspace.center, 0.0]
    distance = float(np.linalg.norm(offset))
    elevation, azimuth = np.rad2deg([np.arcsin(offset[2] / distance), np.arctan2(offset[1], offset[0])])
    facts = [
        f"{name} at {elevation:.0f}° elevation, {azimuth:.0f}° azimuth, {distance:.2f} m",
        f"sees {measures.visible:.0%} of the workspace, at least {measures.resolution:.2f} px/mm",
        *(f"{share:.0%} of {view} inferred" for view, share in measures.holes.items()),
    ]
    outlined = {f"{name} and workspace": with_outline(frame.rgb, frame.camera, frame.workspace)}
    others = {key: image for key, image in sample.stored.items() if key != name and not key.endswith("_depth")}
    images = {}
    for key in others | made:
        by_origin = {origin: known[key] for origin, known in (("stored", others), ("computed", made)) if key in known}
        for origin, image in by_origin.items():
            images[f"{key}, {origin}" if len(by_origin) > 1 else key] = _displayable(image)
    if path is not None:
        label, image = next(iter(outlined.items()))
        outlined = {label: path.in_camera(image, frame.camera, sample.index)}
        views = [key for key in (f"{name}_reproj", f"{name}_persp") if key in others | made]
        if views:
            outlined["the gripper's path"] = path.on_view(_displayable((others | made)[views[0]]), sample.index)
    return SheetRow(sample.title, facts, outlined | images)


def _warnings(
    config: PreviewConfig, views: dict[str, View], workspace: Workspace, measured: list[Measures]
) -> list[str]:
    """Return the warnings about the worst of the measured frames."""
    warnings = []
    visible, resolution = (min(getattr(measures, name) for measures in measured) for name in ("visible", "resolution"))
    if visible < MINIMUM_VISIBLE:
        warnings.append(
            f"camera {config.camera} sees {visible:.0%} of the workspace, less than {MINIMUM_VISIBLE:.0%}: "
            "move or rotate the camera, or check --workspace and --calibration"
        )
    for name in measured[0].holes:
        holes = max(measures.holes[name] for measures in measured)
        if holes > config.max_holes:
            warnings.append(
                f"{holes:.0%} of the pixels of {name} are inferred, more than --max_holes={config.max_holes:g}: "
                "lower --size, or use --reproj.infill=splat, which draws a pixel with its footprint"
            )
    for name, view in views.items():
        drawn = view.size * MILLIMETRE / workspace.size
        if LEAST_DETAIL * drawn > resolution:
            smaller = f"--size={SMALLEST_TRAINED}, " if view.size > SMALLEST_TRAINED else ""
            warnings.append(
                f"view {name} draws {drawn:.2f} px/mm, camera {config.camera} resolves {resolution:.2f} at worst: "
                f"use {smaller}a closer camera or one with a higher resolution"
            )
    return warnings


def _displayable(image: NDArray) -> NDArray[np.uint8]:
    return image if image.ndim == 3 else grey(image)


def main() -> None:
    """Run the console command."""
    run_command(with_device(PreviewConfig), preview, EXAMPLES, short={"--root": "--dataset.root", **POSE_FLAGS})
