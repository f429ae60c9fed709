"""`symview-add-views`: writes a dataset again with views as new camera keys."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tqdm import tqdm

from lerobot_symview import keys
from lerobot_symview.calibration.file import plain_calibration, read_calibration
from lerobot_symview.datasets.derivation import (
    MADE_FROM,
    Derivation,
    cut_parts,
    derived_schema,
    finish,
    source_fingerprint,
    write_part,
)
from lerobot_symview.datasets.features import Features, calibration_features, stored_workspace, view_features
from lerobot_symview.datasets.hub import PushedDataset, push_dataset
from lerobot_symview.datasets.source import EpisodeTables, FrameReader, SourceDataset
from lerobot_symview.geometry.camera import CalibrationError
from lerobot_symview.geometry.workspace import Workspace, check_visible
from lerobot_symview.runtime.cli import DatasetTarget, check_repo_id, run_command
from lerobot_symview.runtime.executors import EXECUTORS
from lerobot_symview.runtime.staging import is_complete, open_partial, partial_folder, plain, remove_partial
from lerobot_symview.views import PerspectiveView, ReprojectedView, View, choose_views

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-add-views --dataset.repo_id=me/picking --new_repo_id=me/picking_views --views='[reproj, persp]'
  symview-add-views --dataset.repo_id=me/picking --dataset.root=data/picking \\
      --new_repo_id=me/picking_reproj --new_root=data/picking_reproj --views='[reproj]' --size=76 --keep='[]'
  symview-add-views --dataset.repo_id=me/real --calibration=cameras.yaml --camera=front --num_workers=4 \\
      --reproj.clip=0.15 --reproj.source_scale=2
  symview-add-views --dataset.repo_id=me/picking --new_repo_id=me/stock --size=76 --for_stock_policies=true"""


@dataclass(frozen=True)
class AddViewsConfig:
    """Write a dataset again with views from above as new camera keys. The source is not modified."""

    dataset: PushedDataset
    """The source: it must hold the camera's images, and its calibration unless `calibration` states it. What is said of
    the Hub is of the result.
    """
    new_repo_id: str = ""
    """Name of the result; by default that of the source with `_views` appended."""
    new_root: Path | None = None
    """Folder of the result; by default LeRobot's own cache folder for `new_repo_id`."""
    views: list[str] = field(default_factory=lambda: ["reproj"])
    """Which views to add: reproj (needs depth), persp."""
    camera: str = "side"
    """Camera they are made from."""
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
    keep: list[str] | None = None
    """Source image keys to keep, without `observation.images.`; by default all. `[]` leaves the views alone."""
    for_stock_policies: bool = False
    """Only what LeRobot's own policies take: no source image, unless `keep` names it, and no height, which has one
    channel.
    """
    num_workers: int = 1
    """Processes that make views side by side. The data does not depend on it."""
    resume: bool = False
    """Go on where an earlier run of the same command was interrupted."""

    def __post_init__(self) -> None:
        if self.num_workers < 1:
            raise ValueError(f"--num_workers must be at least 1, got {self.num_workers}")
        if self.new_repo_id:
            check_repo_id(self.new_repo_id, "--new_repo_id")
        self.chosen_views()

    def chosen_views(self) -> dict[str, View]:
        """Return the views by name."""
        views = choose_views(self.views, self.size, {"reproj": self.reproj, "persp": self.persp})
        return {name: _in_color(name, view) for name, view in views.items()} if self.for_stock_policies else views

    def kept_images(self) -> list[str] | None:
        """Return the names of the source's images that are kept; None if all are."""
        return [] if self.keep is None and self.for_stock_policies else self.keep

    def target(self) -> DatasetTarget:
        """Return where the result goes."""
        return DatasetTarget(self.new_repo_id or f"{self.dataset.repo_id}_views", self.new_root)


def add_views(config: AddViewsConfig) -> Path:
    """Write the dataset that `config` describes, upload it if asked, and return its folder.

    Every frame's views are computed from its own calibration, so a camera may move. Original columns are copied bit for
    bit and videos as files; statistics cover the new keys.
    """
    folder = _write(config)
    if config.dataset.push_to_hub:
        push_dataset(config.target(), config.dataset)
    return folder


def _write(config: AddViewsConfig) -> Path:
    source, target = SourceDataset(config.dataset.folder()), config.target().folder()
    _check_apart(source.folder, target)
    with EXECUTORS["local"](config.num_workers, "lerobot_symview.datasets.derivation") as executor:
        derivation = _plan(config, source, partial_folder(target))
        description = _description(config, derivation)
        if is_complete(target, MADE_FROM, description, config.resume, "--new_root"):
            logger.info("%s is complete already", target)
            return target
        _check_first_frame(derivation, source)
        parts = cut_parts(source)
        open_partial(derivation.folder, description, config.resume)
        names = ", ".join(derivation.views)
        with tqdm(desc=names, total=source.info["total_frames"], unit="frame") as bar:
            for frames in executor.run(partial(write_part, derivation), list(enumerate(parts))):
                bar.update(frames)
    finish(derivation, parts, description).rename(target)
    remove_partial(derivation.folder)
    logger.info("wrote %d frames with %s to %s", source.info["total_frames"], names, target)
    return target


def _check_apart(source: Path, target: Path) -> None:
    """Raise a ValueError if what is written would lie in what is read, or the other way round."""
    source = source.resolve()
    for written in (target.resolve(), partial_folder(target).resolve()):
        if written.is_relative_to(source) or source.is_relative_to(written):
            raise ValueError(
                f"the result would be written to {written} and the source is in {source}: "
                "neither may lie in the other, choose another --new_root"
            )


def _plan(config: AddViewsConfig, source: SourceDataset, folder: Path) -> Derivation:
    calibration = read_calibration(config.calibration) if config.calibration else None
    in_file = calibration.workspace if calibration is not None else None
    workspace = config.workspace or in_file or stored_workspace(source.features)
    views = config.chosen_views()
    added: Features = {}
    if calibration is not None:
        check_visible(
            config.camera, calibration.camera(config.camera), workspace, f"check the poses in {config.calibration}"
        )
        added |= calibration_features(config.camera)
    stated = plain_calibration(calibration) if calibration is not None else None
    for name, view in views.items():
        added |= view_features(config.camera, name, view, workspace, stated)
    kept = config.kept_images()
    dropped = [
        key
        for key, feature in source.features.items()
        if feature["dtype"] in ("image", "video") and kept is not None and key.removeprefix(keys.rgb("")) not in kept
    ]
    reader = FrameReader(source, config.camera, workspace, views.values(), calibration)
    reader.check()
    _check_names(config, source.features, added)
    source.check_files([key for key in source.features if key not in dropped or key in reader.features()])
    return Derivation(
        source.folder,
        source_fingerprint(source),
        folder,
        config.camera,
        views,
        workspace,
        calibration,
        dropped,
        added,
        derived_schema(source, dropped, added),
    )


def _check_names(config: AddViewsConfig, features: Features, added: Features) -> None:
    existing = [key for key in added if key in features]
    if existing:
        raise ValueError(f"the dataset has {', '.join(existing)} already: take them out of --views or --calibration")
    prefix = keys.rgb("")
    images = sorted(key.removeprefix(prefix) for key in features if key.startswith(prefix))
    unknown = sorted(set(config.keep or []) - set(images))
    if unknown:
        raise ValueError(f"--keep names {', '.join(unknown)}, which the dataset lacks; it has {', '.join(images)}")


def _check_first_frame(derivation: Derivation, source: SourceDataset) -> None:
    """Make the views once, so that what is wrong with all frames is said before anything is written."""
    reader = derivation.reader(source)
    frame = next(reader.frames(0, EpisodeTables(source, source.data_file(0), reader.columns()).read(0)))
    for view in derivation.views.values():
        view.render(frame)
    if derivation.calibration is None:
        try:
            check_visible(
                derivation.camera, frame.camera, derivation.workspace, "views will be empty where it sees none"
            )
        except CalibrationError as error:
            logger.warning("%s", error)


def _description(config: AddViewsConfig, derivation: Derivation) -> dict[str, Any]:
    """What determines the result."""
    return plain(
        {
            "repo_id": config.target().repo_id,
            "source": config.dataset.repo_id,
            "source_files": derivation.source_files,
            "camera": config.camera,
            "views": {name: asdict(view) for name, view in derivation.views.items()},
            "workspace": asdict(derivation.workspace),
            "calibration": plain_calibration(derivation.calibration) if derivation.calibration else None,
            "left_out": derivation.dropped,
            "symview": version("lerobot_policy_symview"),
        }
    )


def _in_color(name: str, view: View) -> View:
    """Return a view without its height, which a policy for images of three channels does not take.

    Raises:
        ValueError: if the view `name` has one and no option `height` to do without.
    """
    if any(option.name == "height" for option in fields(view)):
        view = replace(view, height=False)
    single = [output for output, kind in view.outputs.items() if kind == "height"]
    if single:
        raise ValueError(
            f"--for_stock_policies=true takes images of three channels, the view {name!r} has one in "
            f"{', '.join(single)}: take it out of --views"
        )
    return view


def main() -> None:
    """Run the console command."""
    run_command(AddViewsConfig, add_views, EXAMPLES, short={"--root": "--dataset.root"})
