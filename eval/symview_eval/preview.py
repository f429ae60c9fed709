"""`symview-preview`: what a dataset's camera sees and what its views make of it, before or after they are added."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lerobot_symview import keys
from lerobot_symview.datasets.add_views import calibration_and_workspace, views_for_dataset
from lerobot_symview.datasets.features import Features
from lerobot_symview.datasets.source import EpisodeTables, FrameReader, SourceDataset, is_depth_feature
from lerobot_symview.geometry.camera import Camera, project
from lerobot_symview.geometry.workspace import MINIMUM_VISIBLE, Workspace
from lerobot_symview.runtime.cli import CommandError, DatasetLocation, flagged, run_command
from lerobot_symview.runtime.view_flags import views_from_flags
from lerobot_symview.views import Frame, PerspectiveView, ReprojectedView, View, ViewSpec
from symview_eval.contact_sheet import Row, grey, montage, page, with_outline
from symview_eval.rerun_recording import RerunRecording

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-preview --dataset.repo_id=me/picking
  symview-preview --dataset.repo_id=me/real --calibration=cameras.yaml --camera=front --episodes='[0, 7]' \\
      --reproj.source_scale=2 --output_dir=preview"""

LATTICE = 9  # points per side of the workspace at which the camera's resolution is measured
MILLIMETRE = 0.001


@dataclass(frozen=True)
class PreviewConfig:
    """Show moments of a dataset: the camera's image with the workspace, the views, what is seen and what inferred.

    Writes preview.png, preview.html and, for `rerun`, preview.rrd, and warns about a camera that sees too little, views
    with many holes, and a camera too coarse for them.
    """

    dataset: DatasetLocation
    """The dataset."""
    episodes: list[int] = field(default_factory=lambda: [0])
    """Which episodes."""
    frames: int = 4
    """How many moments of each, evenly spaced."""
    camera: str = "side"
    """Camera that views are made from; a dataset that holds only views is shown as it is."""
    views: list[ViewSpec] | None = None
    """Which views to compute; by default those that the dataset does not store and has the images for, and those whose
    options are stated. Stored ones are shown as they are.
    """
    size: int | None = None
    """Rows and columns of all views, in place of each one's own."""
    reproj: ReprojectedView = field(default_factory=ReprojectedView)
    """Options of the view reproj."""
    persp: PerspectiveView = field(default_factory=PerspectiveView)
    """Options of the view persp."""
    calibration: Path | None = None
    """YAML or JSON file with the camera's calibration, for a dataset without; see docs/own_camera.md."""
    workspace: Workspace | None = None
    """What the views show, such as `--workspace.center='[0.5, 0.1]' --workspace.size=0.5`; by default what
    `calibration` says, else the dataset, else the simulator's. The gripper's x and y count from its centre.
    """
    max_holes: float = 0.5
    """Share of a reprojected view's pixels that may be inferred without a warning."""
    rerun: bool = field(default_factory=lambda: find_spec("rerun") is not None)
    """Write preview.rrd; by default if rerun is installed."""
    output_dir: Path = Path("preview")
    """Folder of the files."""

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise ValueError(f"--frames must be at least 1, got {self.frames}")
        if not self.episodes:
            raise ValueError("--episodes is empty, name at least one")
        if not 0 <= self.max_holes <= 1:
            raise ValueError(f"--max_holes must lie in [0, 1], got {self.max_holes}")


@dataclass(frozen=True)
class Moment:
    """A frame of a dataset: what views are made from, where the dataset has that, and what it stores."""

    episode: int
    index: int
    frame: Frame | None
    stored: dict[str, NDArray]
    """Every image, by name: colour (H, W, 3) uint8 or distances (H, W)."""

    @property
    def title(self) -> str:
        """Which moment it is."""
        return f"episode {self.episode}, frame {self.index}"


def read_moments(source: SourceDataset, reader: FrameReader | None, episode: int, indices: list[int]) -> list[Moment]:
    """Return some frames of an episode."""
    table = EpisodeTables(source, source.data_file(episode)).read(episode)
    images = [key for key, feature in source.features.items() if feature["dtype"] in ("image", "video")]
    moments = []
    for index in indices:
        row = table.slice(index, 1)
        stored = {key.removeprefix(keys.rgb("")): next(source.images(key, episode, row)) for key in images}
        moments.append(Moment(episode, index, next(reader.frames(episode, row)) if reader else None, stored))
    return moments


@dataclass(frozen=True)
class Measures:
    """What can be measured of one moment."""

    visible: float
    """Share of the working volume in the camera's image."""
    resolution: float
    """The camera's pixels per millimetre of the table, at the least."""
    holes: dict[str, float]
    """Share of each view's pixels that are inferred, where that is known."""


def preview(config: PreviewConfig) -> Path:
    """Write the files that `config` describes and return their folder."""
    with flagged("--dataset"):
        source = SourceDataset(config.dataset.folder())
    total = len(source.episodes)
    unknown = [episode for episode in config.episodes if not 0 <= episode < total]
    if unknown:
        raise CommandError(f"--episodes names {unknown}, the dataset has {total} episodes, from 0")
    reader, views = _chosen(config, source)
    config.output_dir.mkdir(parents=True, exist_ok=True)
    recording = None
    if config.rerun and reader is not None:
        recording = RerunRecording(config.output_dir / "preview.rrd", reader.workspace)
    rows, measured = [], []
    for episode in tqdm(config.episodes, desc="preview", unit="episode"):
        length = source.episodes[episode]["length"]
        indices = np.unique(np.linspace(0, length - 1, config.frames).round().astype(int)).tolist()
        for moment in read_moments(source, reader, episode, indices):
            if moment.frame is None or reader is None:
                shown = {name: _shown(image) for name, image in moment.stored.items()}
                rows.append(Row(moment.title, [], shown))
                continue
            made = _render(moment.frame, config.camera, views)
            measures = _measure(moment.frame.camera, reader.workspace, made)
            rows.append(_row(config.camera, moment, moment.frame, made, measures))
            measured.append(measures)
            if recording is not None:
                stored = {name: moment.stored[name] for name in _stored_views(source.features)}
                recording.add(len(rows) - 1, config.camera, moment.frame, stored | made)
    if recording is not None:
        recording.close()
    warnings = _warnings(config, views, reader.workspace, measured) if reader is not None else []
    for warning in warnings:
        logger.warning("%s", warning)
    montage(rows).save(config.output_dir / "preview.png")
    (config.output_dir / "preview.html").write_text(page(config.dataset.repo_id, rows, warnings))
    logger.info("wrote %s", ", ".join(str(file) for file in sorted(config.output_dir.glob("preview.*"))))
    return config.output_dir


def _chosen(config: PreviewConfig, source: SourceDataset) -> tuple[FrameReader | None, dict[str, View]]:
    """Return the reader of the camera's frames, None for a dataset of views alone, and the views to make."""
    if keys.rgb(config.camera) not in source.features:
        if config.views is None and config.calibration is None:
            return None, {}
        raise ValueError(f"the dataset has no camera {config.camera!r}: check --camera")
    calibration, workspace = calibration_and_workspace(config.calibration, config.workspace, source.features)
    options: dict[str, View] = {"reproj": config.reproj, "persp": config.persp}
    specs = config.views
    if specs is None:
        specs = [ViewSpec(name) for name, view in options.items() if _is_wanted(config, view, source.features)]
    views = views_from_flags(specs, config.size, options) if specs else {}
    views = views_for_dataset(views, source.features)
    read_for = [*views.values()]
    if config.rerun and is_depth_feature(source.features.get(keys.depth(config.camera), {})):
        read_for.append(ReprojectedView(clip="none"))  # a recording has the point cloud even if no view needs it
    reader = FrameReader(source, config.camera, workspace, read_for, calibration)
    with flagged(f"--camera={config.camera}, --calibration"):
        reader.check()
    return reader, views


def _is_wanted(config: PreviewConfig, view: View, features: Features) -> bool:
    """Whether a view that is not asked for by name is made: the dataset has what it needs and does not store it."""
    if view.needs_depth and keys.depth(config.camera) not in features:
        return False
    stated = (config.size, config.calibration, config.workspace)
    asked = any(one is not None for one in stated) or view != type(view)()
    return asked or not any(keys.view(config.camera, output) in features for output in view.outputs)


def _stored_views(features: Features) -> list[str]:
    """Return the names of the images that are views."""
    facts = {key: (feature.get("info") or {}).get("symview", {}) for key, feature in features.items()}
    return [key.removeprefix(keys.rgb("")) for key, stated in facts.items() if "view" in stated]


def _render(frame: Frame, camera: str, views: dict[str, View]) -> dict[str, NDArray]:
    """Return every output of the views, and the mask of those that have one, by name."""
    images: dict[str, NDArray] = {}
    for view in views.values():
        images |= view.with_mask().render(frame)
    return {f"{camera}_{output}": image for output, image in images.items()}


def _measure(camera: Camera, workspace: Workspace, made: dict[str, NDArray]) -> Measures:
    masks = {name.removesuffix("_seen"): image for name, image in made.items() if name.endswith("_seen")}
    holes = {name: 1.0 - float((mask > 0).mean()) for name, mask in masks.items()}
    return Measures(workspace.visible_fraction(camera), table_resolution(camera, workspace), holes)


def _row(name: str, moment: Moment, frame: Frame, made: dict[str, NDArray], measures: Measures) -> Row:
    offset = frame.camera.position - [*frame.workspace.center, 0.0]
    distance = float(np.linalg.norm(offset))
    elevation, azimuth = np.rad2deg([np.arcsin(offset[2] / distance), np.arctan2(offset[1], offset[0])])
    facts = [
        f"{name} at {elevation:.0f}° elevation, {azimuth:.0f}° azimuth, {distance:.2f} m",
        f"sees {measures.visible:.0%} of the workspace at {measures.resolution:.2f} px/mm or more",
        *(f"{share:.0%} of {view} inferred" for view, share in measures.holes.items()),
    ]
    outlined = {f"{name} and workspace": with_outline(frame.rgb, frame.camera, frame.workspace)}
    others = {key: image for key, image in moment.stored.items() if key != name and not key.endswith("_depth")}
    images = {}
    for key in others | made:
        found = {origin: known[key] for origin, known in (("stored", others), ("computed", made)) if key in known}
        for origin, image in found.items():
            images[f"{key}, {origin}" if len(found) > 1 else key] = _shown(image)
    return Row(moment.title, facts, outlined | images)


def _warnings(
    config: PreviewConfig, views: dict[str, View], workspace: Workspace, measured: list[Measures]
) -> list[str]:
    """Say what is too little at some moment."""
    warnings = []
    visible, resolution = (min(getattr(one, name) for one in measured) for name in ("visible", "resolution"))
    if visible < MINIMUM_VISIBLE:
        warnings.append(
            f"{config.camera} sees {visible:.0%} of the workspace, less than {MINIMUM_VISIBLE:.0%}: move or turn it"
        )
    for name in measured[0].holes:
        holes = max(one.holes[name] for one in measured)
        if holes > config.max_holes:
            warnings.append(
                f"{holes:.0%} of {name} is inferred, more than --max_holes={config.max_holes:g}: "
                "raise the view's source_scale or lower --size"
            )
    for name, view in views.items():
        asked = view.size * MILLIMETRE / workspace.size
        if resolution < asked:
            warnings.append(
                f"{name} asks for {asked:.2f} px/mm and {config.camera} gives {resolution:.2f} where it gives least: "
                f"--size={int(resolution * workspace.size / MILLIMETRE)} would show as much, "
                "a nearer or finer camera more"
            )
    return warnings


def table_resolution(camera: Camera, workspace: Workspace) -> float:
    """Return how many of the camera's pixels a millimetre of the table spans, where and along what it spans the least.

    Zero if a part of the table lies behind the camera.
    """
    steps = np.linspace(0.5 / LATTICE, 1 - 0.5 / LATTICE, LATTICE) * workspace.size - workspace.size / 2
    x, y = np.meshgrid(steps + workspace.center[0], steps + workspace.center[1])
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    here, depth = project(points, camera)
    if (depth <= 0).any():
        return 0.0
    moved = [project(points + step, camera)[0] - here for step in np.eye(3)[:2] * MILLIMETRE]
    return float(np.linalg.svd(np.stack(moved, axis=-1), compute_uv=False)[:, -1].min())


def _shown(image: NDArray) -> NDArray[np.uint8]:
    return image if image.ndim == 3 else grey(image)


def main() -> None:
    """Run the console command."""
    run_command(PreviewConfig, preview, EXAMPLES, short={"--root": "--dataset.root"})
