"""`symview-add-views`: writes a dataset again with views as new camera keys."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lerobot_symview import keys
from lerobot_symview.camera import Camera
from lerobot_symview.cli import CommandError, DatasetTarget, run_command
from lerobot_symview.features import Features, stored_workspace, view_features
from lerobot_symview.staging import staged
from lerobot_symview.views import Frame, View, make_view
from lerobot_symview.workspace import Workspace

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-add-views --dataset.repo_id=me/picking --new_repo_id=me/picking_views --views='[reproj, persp]'
  symview-add-views --dataset.repo_id=me/picking --dataset.root=data/picking \\
      --new_repo_id=me/picking_reproj --new_root=data/picking_reproj --views='[reproj]' --size=76 --keep='[]'"""


@dataclass(frozen=True)
class AddViewsConfig:
    """Write a dataset again with views from above as new camera keys. The source is not modified."""

    dataset: DatasetTarget
    """The source: it must hold the camera's images and its calibration."""
    new_repo_id: str = ""
    """Name of the result; by default that of the source with `_views` appended."""
    new_root: Path | None = None
    """Folder of the result; by default LeRobot's own cache folder for `new_repo_id`."""
    views: list[str] = field(default_factory=lambda: ["reproj"])
    """Which views to add: reproj (needs depth), persp."""
    camera: str = "side"
    """Camera they are made from."""
    size: int = 152
    """Rows and columns of the views."""
    keep: list[str] | None = None
    """Source image keys to keep, without `observation.images.`; by default all. Calibration goes with its camera."""

    def __post_init__(self) -> None:
        if not self.views:
            raise ValueError("--views is empty, name at least one view")
        self.make_views()

    def make_views(self) -> dict[str, View]:
        """Return the views by name."""
        return {name: make_view(name, size=self.size) for name in self.views}

    def target(self) -> DatasetTarget:
        """Return where the result goes."""
        return DatasetTarget(self.new_repo_id or f"{self.dataset.repo_id}_views", self.new_root)


def add_views(config: AddViewsConfig) -> Path:
    """Write the dataset that `config` describes and return its folder.

    Every frame's views are computed from its own calibration, so a camera may move. Original keys are copied bit for
    bit; statistics cover the new keys.
    """
    source_folder, target = config.dataset.folder(), config.target().folder()
    if not (source_folder / "meta" / "info.json").is_file():
        raise CommandError(f"no dataset at {source_folder}: check --dataset.repo_id and --dataset.root")
    with staged(target, "--new_root") as partial:
        from lerobot.datasets import LeRobotDataset

        source = LeRobotDataset(config.dataset.repo_id, root=source_folder, depth_output_unit="m")
        features = source.meta.features
        views, workspace = config.make_views(), stored_workspace(features)
        _check_inputs(config, features, views)
        added = {
            key: feature
            for name, view in views.items()
            for key, feature in view_features(config.camera, name, view, workspace).items()
        }
        images = _render(source, config.camera, views, workspace)
        _write(source, partial, config, added, images)
        _write_stats(partial, added, images)
    logger.info("wrote %d frames with %s to %s", len(images), ", ".join(views), target)
    return target


def _check_inputs(config: AddViewsConfig, features: Features, views: dict[str, View]) -> None:
    camera = config.camera
    needed = [keys.rgb(camera), keys.intrinsics(camera), keys.world_from_cam(camera), keys.STATE]
    if any(view.needs_depth for view in views.values()):
        needed.append(keys.depth(camera))
    missing = [key for key in needed if key not in features]
    if missing:
        cameras = sorted(key.split(".")[2] for key in features if key.endswith(".intrinsics"))
        raise ValueError(f"the dataset lacks {missing}; --camera={camera}, calibrated cameras: {cameras or 'none'}")
    existing = [
        key for name, view in views.items() for key in (keys.view(camera, o) for o in view.outputs) if key in features
    ]
    if existing:
        raise ValueError(f"the dataset has {existing} already: take them out of --views")
    unknown = [name for name in config.keep or [] if keys.rgb(name) not in features]
    if unknown:
        known = sorted(key.removeprefix("observation.images.") for key in features if "observation.images." in key)
        raise ValueError(f"--keep names {unknown}, which the dataset lacks; it has {known}")


def _render(
    source: LeRobotDataset, camera: str, views: dict[str, View], workspace: Workspace
) -> list[dict[str, NDArray[Any]]]:
    frames = []
    for index in tqdm(range(len(source)), desc=f"rendering {', '.join(views)}", unit="frame"):
        item = source[index]
        rgb = (item[keys.rgb(camera)] * 255).round().byte().permute(1, 2, 0).numpy()
        depth = item[keys.depth(camera)][0].numpy() if keys.depth(camera) in item else None
        frame = Frame(
            rgb=rgb,
            depth=depth,
            camera=Camera(
                item[keys.intrinsics(camera)].numpy().reshape(3, 3),
                item[keys.world_from_cam(camera)].numpy().reshape(4, 4),
                *rgb.shape[:2],
            ),
            workspace=workspace,
            gripper=item[keys.STATE].numpy(),
        )
        images: dict[str, NDArray[Any]] = {}
        for view in views.values():
            images |= {keys.view(camera, output): image for output, image in view.render(frame).items()}
        frames.append(images)
    return frames


def _write(
    source: LeRobotDataset, folder: Path, config: AddViewsConfig, added: Features, images: list[dict[str, NDArray[Any]]]
) -> None:
    from lerobot.datasets import modify_features

    dropped = []
    if config.keep is not None:
        kept = {keys.rgb(name) for name in config.keep}
        dropped = [
            key
            for key, feature in source.meta.features.items()
            if feature["dtype"] in ("image", "video") and key not in kept
        ]

    def value_of(key: str) -> Any:
        return lambda row, episode, frame: images[int(row["index"])][key]

    modify_features(
        source,
        add_features={key: (value_of(key), feature) for key, feature in added.items()},
        remove_features=dropped or None,
        output_dir=folder,
        repo_id=config.target().repo_id,
    )


def _write_stats(folder: Path, added: Features, images: list[dict[str, NDArray[Any]]]) -> None:
    """Add the new keys' statistics, which LeRobot leaves out; without them `lerobot-train` fails on image keys."""
    from lerobot.datasets.compute_stats import get_feature_stats

    path = folder / "meta" / "stats.json"
    stats = json.loads(path.read_text())
    for key, feature in added.items():
        is_color = feature["shape"][-1] == 3
        stacked = np.stack([frame[key] for frame in images])
        channels_first = stacked.transpose(0, 3, 1, 2) if is_color else stacked[:, None]
        scaled = channels_first / 255.0 if is_color else channels_first.astype(np.float64)
        values = get_feature_stats(scaled, axis=(0, 2, 3), keepdims=True)
        stats[key] = {name: (value if name == "count" else value[0]).tolist() for name, value in values.items()}
    path.write_text(json.dumps(stats, indent=4))


def main() -> None:
    """Run the console command."""
    run_command(AddViewsConfig, add_views, EXAMPLES)
