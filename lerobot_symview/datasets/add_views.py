"""`symview-add-views`: adds top-down views to a dataset as new camera keys."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lerobot_symview import keys
from lerobot_symview.calibration.file import Calibration, plain_calibration
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.calibration.readings import PoseReading, ReadingError
from lerobot_symview.datasets.calibration_check import check_calibration, with_depth_units
from lerobot_symview.datasets.derivation import derived_schema, source_fingerprint, write_dataset
from lerobot_symview.datasets.features import (
    Features,
    calibration_features,
    gripper_dimensions,
    image_size,
    names_of,
    stored_workspace,
    view_features,
)
from lerobot_symview.datasets.frame_reader import FrameReader
from lerobot_symview.datasets.hub import HubDataset, push_dataset
from lerobot_symview.datasets.metadata import ADDED_VIEWS
from lerobot_symview.datasets.source import EpisodeTables, SourceDataset
from lerobot_symview.datasets.view_derivation import ViewDerivation
from lerobot_symview.geometry.gripper_state import REQUIRED
from lerobot_symview.geometry.state_reader import StateOrigin, StateReader
from lerobot_symview.geometry.units import parse_unit
from lerobot_symview.geometry.visibility import check_camera, detail
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import DatasetLocation, check_repo_id, flagged, run_command
from lerobot_symview.runtime.executors import EXECUTORS
from lerobot_symview.runtime.staging import is_complete, partial_folder, plain
from lerobot_symview.runtime.view_flags import views_from_flags
from lerobot_symview.views import PerspectiveView, ReprojectedView, View, ViewSpec

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-add-views --dataset.repo_id=me/picking --new_repo_id=me/picking_views --views='[reproj, persp]'
  symview-add-views --dataset.repo_id=me/picking --dataset.root=data/picking \\
      --new_repo_id=me/picking_reproj --new_root=data/picking_reproj --views='[reproj]' --size=76 --keep='[]'
  symview-add-views --dataset.repo_id=me/real --calibration=cameras.yaml --camera=front --num_workers=4 \\
      --reproj.clip=0.15 --reproj.source_scale=2
  symview-add-views --dataset.repo_id=me/real --calibration='[camera_info.yaml, handeye.calib]' --camera=front
  symview-add-views --dataset.repo_id=me/real --calibration=cameras.yaml --camera=front --reproj.cameras='[front, left]'
  symview-add-views --dataset.repo_id=me/picking --new_repo_id=me/stock --size=76 --for_stock_policies=true"""

POSE_FLAGS = {
    "--pose_direction": "--pose.direction",
    "--quaternion_order": "--pose.quaternion_order",
    "--camera_axes": "--pose.camera_axes",
}
"""Short flags of the commands that read poses -> the fields of their `PoseReading`."""


@dataclass(frozen=True)
class AddViewsConfig:
    """Add top-down views to a dataset as new camera keys. The result is a new dataset; the source is not modified."""

    dataset: HubDataset
    """The source dataset, with the camera's images and calibration; the Hub options apply to the new dataset."""
    new_repo_id: str = ""
    """`user/name` of the new dataset; by default the source's with `_views` appended."""
    new_root: Path | None = None
    """Folder of the new dataset; by default LeRobot's cache folder for `new_repo_id`."""
    views: list[ViewSpec] = field(default_factory=lambda: [ViewSpec("reproj")])
    """Views to add, by name or with options: `[reproj, {name: persp, plane_height: 0.025}]`. reproj needs depth."""
    camera: str = "side"
    """Camera whose images the views are rendered from, and under whose name they are stored. A view's option `cameras`
    merges further ones."""
    size: int | None = None
    """Rows and columns of the views; a size given in `views` takes precedence."""
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
    """Square on the table that the views show, such as `--workspace.center='[0.5, 0.1]' --workspace.size=0.5`; by
    default that of the calibration file, else of the dataset, else of the simulator. The gripper's x and y are relative
    to its centre."""
    state_origin: StateOrigin | None = None
    """What the positions in the state count from: the workspace's centre (workspace), the world, or the robot's base
    (base), whose pose is `robot_base` in the calibration file; by default base for LeRobot's ee.x, …, else workspace.
    """
    keep: list[str] | None = None
    """Source image keys to keep, without `observation.images.`; by default all. `[]` keeps none."""
    for_stock_policies: bool = False
    """Write only images that LeRobot's own policies accept: no source images, unless `keep` names them, and no height
    maps, which have one channel."""
    num_workers: int = 1
    """Processes that render views in parallel. The result does not depend on their number."""
    resume: bool = False
    """Continue an interrupted run of the same command."""

    def __post_init__(self) -> None:
        if self.num_workers < 1:
            raise ValueError(f"--num_workers must be at least 1, got {self.num_workers}")
        if self.new_repo_id:
            check_repo_id(self.new_repo_id, "--new_repo_id")
        self.make_views()
        unit_from_flag(self.depth_unit)

    def make_views(self) -> dict[str, View]:
        """Return the views by name.

        Raises:
            OptionError: if a view or an option is unknown or invalid.
            ValueError: if a view has a one-channel output that `for_stock_policies` cannot disable.
        """
        views = views_from_flags(self.views, self.size, {"reproj": self.reproj, "persp": self.persp})
        if not self.for_stock_policies:
            return views
        try:
            return {name: view.in_color() for name, view in views.items()}
        except ValueError as error:
            raise ValueError(f"--for_stock_policies=true accepts three-channel images only: {error}") from None

    def kept_images(self) -> list[str] | None:
        """Return the names of the source images to keep; None for all."""
        return [] if self.keep is None and self.for_stock_policies else self.keep

    def target(self) -> DatasetLocation:
        """Return the location of the new dataset."""
        return DatasetLocation(self.new_repo_id or f"{self.dataset.repo_id}_views", self.new_root)


def add_views(config: AddViewsConfig) -> Path:
    """Write the dataset with the views of `config`, upload it with `push_to_hub`, and return its folder.

    Views are rendered with the calibration of each frame, so cameras may move. Original columns are bit-identical to
    the source's, videos are copied as files, and statistics are added for the new keys.
    """
    folder = _write(config)
    if config.dataset.push_to_hub:
        push_dataset(config.target(), config.dataset)
    return folder


def _write(config: AddViewsConfig) -> Path:
    with flagged("--dataset"):
        source = SourceDataset(config.dataset.folder())
    target = config.target().folder()
    check_apart(source.folder, target)
    executor = EXECUTORS["local"](config.num_workers, ViewDerivation.__module__)  # starts while this plans
    derivation = _plan(config, source, partial_folder(target))
    description = _description(config, derivation)
    if is_complete(target, ADDED_VIEWS, description, config.resume, "--new_root"):
        logger.info("%s is already complete", target)
        return target
    _check_first_frame(derivation, source)
    names = ", ".join(derivation.views)
    write_dataset(derivation, executor, target, names, description, ADDED_VIEWS, config.resume)
    logger.info("wrote %d frames with %s to %s", source.info["total_frames"], names, target)
    return target


def check_apart(source: Path, target: Path) -> None:
    """Raise a ValueError if the source and the result would lie within each other."""
    source = source.resolve()
    for written in (target.resolve(), partial_folder(target).resolve()):
        if written.is_relative_to(source) or source.is_relative_to(written):
            raise ValueError(
                f"the result would be written to {written} and the source is in {source}: "
                "neither may be inside the other, choose another --new_root"
            )


def _plan(config: AddViewsConfig, source: SourceDataset, folder: Path) -> ViewDerivation:
    calibration, workspace = calibration_and_workspace(
        config.calibration, config.workspace, source.features, config.camera, config.pose
    )
    views = views_for_dataset(config.make_views(), source.features)
    reader = FrameReader(
        source, config.camera, workspace, views.values(), calibration, state_origin=config.state_origin
    )
    added: Features = {}
    with flagged(f"--calibration={_listed(config.calibration)}"):
        for name, camera in reader.given_cameras().items():
            check_camera(name, camera, workspace)
            has_lens, has_sensor = camera.lens is not None, camera.depth_sensor is not None
            added |= calibration_features(name, lens=has_lens, depth_sensor=has_sensor)
    for name, view in views.items():
        added |= view_features(config.camera, name, view, workspace)
    kept = config.kept_images()
    dropped = [
        key
        for key, feature in source.features.items()
        if feature["dtype"] in ("image", "video") and kept is not None and key.removeprefix(keys.IMAGES) not in kept
    ]
    with flagged(f"--camera={config.camera}, --calibration"):
        reader.check()
        reader = with_depth_units(reader, unit_from_flag(config.depth_unit))
    _check_names(config, source.features, added)
    source.check_files([key for key in source.features if key not in dropped or key in reader.features()])
    return ViewDerivation(
        source=source.folder,
        source_files=source_fingerprint(source),
        folder=folder,
        camera=config.camera,
        views=views,
        workspace=workspace,
        calibration=calibration,
        depth_units=dict(reader.depth_units),
        state_origin=config.state_origin,
        dropped=dropped,
        added=added,
        schema=derived_schema(source, dropped, added),
    )


def calibration_and_workspace(
    files: Path | list[Path] | None, workspace: Workspace | None, features: Features, camera: str, pose: PoseReading
) -> tuple[Calibration | None, Workspace]:
    """Return the calibration of `files`, and the workspace: the argument, else the file's, else the dataset's."""
    if files is None:
        return None, workspace or stored_workspace(features)
    shown = workspace or stored_workspace(features)
    with pose_flagged("--calibration"):
        calibration = read_calibration(files, camera, image_size(features, keys.rgb(camera)), shown, pose)
    return calibration, workspace or calibration.workspace or stored_workspace(features)


@contextmanager
def pose_flagged(flag: str) -> Iterator[None]:
    """Prefix errors of a calibration with its flag; where the reading of its pose is open, name the flags for that."""
    try:
        with flagged(flag):
            yield
    except ReadingError as error:
        raise ReadingError(f"{error}; {', '.join(POSE_FLAGS)} and --pose.unit decide") from None


def _listed(files: Path | list[Path] | None) -> str:
    return ", ".join(map(str, files)) if isinstance(files, list) else str(files)


def unit_from_flag(depth_unit: str | None) -> float | None:
    """Return the metres per unit of `--depth_unit`; None if it is not given.

    Raises:
        ValueError: if it is no unit.
    """
    if depth_unit is None:
        return None
    try:
        return parse_unit(depth_unit)
    except ValueError as error:
        raise ValueError(f"--depth_unit: {error}") from None


def views_for_dataset(views: dict[str, View], features: Features) -> dict[str, View]:
    """Return the views, without clipping and gripper image if the dataset lacks the gripper's state."""
    using = [name for name, view in views.items() if view.uses_gripper]
    names = StateReader(tuple(names_of(features, keys.STATE))).read_names
    if not using or gripper_dimensions(features, names) is not None:
        return views
    logger.warning(
        "%s has no dimensions named %s (or LeRobot's ee.x, …): "
        "%s are rendered without clipping at the gripper and without a gripper image",
        keys.STATE,
        ", ".join(REQUIRED),
        ", ".join(using),
    )
    return {name: view.without_gripper() for name, view in views.items()}


def _check_names(config: AddViewsConfig, features: Features, added: Features) -> None:
    existing = [key for key in added if key in features]
    if existing:
        raise ValueError(f"the dataset already has {', '.join(existing)}: change --views or --calibration")
    prefix = keys.IMAGES
    images = sorted(key.removeprefix(prefix) for key in features if key.startswith(prefix))
    unknown = sorted(set(config.keep or []) - set(images))
    if unknown:
        raise ValueError(f"--keep names {', '.join(unknown)}, which the dataset lacks; it has {', '.join(images)}")


def _check_first_frame(derivation: ViewDerivation, source: SourceDataset) -> None:
    """Render the first frame, so that errors of every frame are raised before anything is written; log its detail."""
    reader = derivation.reader
    with flagged(f"--camera={derivation.camera}, --calibration, --depth_unit"):
        check_calibration(reader)
    frame = next(reader.frames(0, EpisodeTables(source, source.data_file(0), reader.columns()).read(0)))
    for view in derivation.views.values():
        view.render(frame)
    sizes = {name: view.size for name, view in derivation.views.items()}
    for name, one in {derivation.camera: frame, **frame.others}.items():
        logger.info("%s", detail(name, one.camera, derivation.workspace, sizes))


def _description(config: AddViewsConfig, derivation: ViewDerivation) -> dict[str, Any]:
    """Return all settings that determine the result, and those of earlier views that say how to read it."""
    source = derivation.open_source()
    earlier = source.added_views
    left_out = {key: image_size(source.features, key) for key in derivation.dropped}
    return plain(
        {
            "repo_id": config.target().repo_id,
            "source": config.dataset.repo_id,
            "source_files": derivation.source_files,
            "camera": config.camera,
            "views": {name: asdict(view) for name, view in derivation.views.items()},
            "workspace": asdict(derivation.workspace),
            "calibration": plain_calibration(derivation.calibration)
            if derivation.calibration
            else earlier.get("calibration"),
            "depth_units": derivation.depth_units,
            "state_origin": derivation.state_origin or earlier.get("state_origin"),
            "left_out": derivation.dropped,
            "image_sizes": earlier.get("image_sizes", {}) | left_out,
            "symview": version("lerobot_policy_symview"),
        }
    )


def main() -> None:
    """Run the console command."""
    run_command(AddViewsConfig, add_views, EXAMPLES, short={"--root": "--dataset.root", **POSE_FLAGS})
