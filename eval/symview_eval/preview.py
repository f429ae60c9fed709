"""`symview-preview`: every image of one moment of a dataset, side by side."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lerobot_symview.cli import CommandError, DatasetTarget, run_command

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-preview --dataset.repo_id=me/picking_views --frame=3 --output=frame.png"""

TILE, GAP, LABEL = 228, 8, 24  # pixels
TITLES = {
    "side": "side camera",
    "side_reproj": "reprojected (RGBD)",
    "side_reproj_height": "reprojected height",
    "side_persp": "perspective (RGB)",
    "side_persp_gripper": "gripper image",
    "top": "oracle from above",
}


@dataclass(frozen=True)
class PreviewConfig:
    """Draw every image of one frame of a dataset side by side into a PNG."""

    dataset: DatasetTarget
    """The dataset."""
    frame: int = 0
    """Index of the frame in the dataset."""
    images: list[str] | None = None
    """Which images, without `observation.images.`; by default all but cameras' raw depth."""
    output: Path = Path("preview.png")
    """The file to write."""


def frame_images(folder: Path, index: int) -> dict[str, NDArray[np.uint8]]:
    """Return the images of frame `index` as (H, W, 3) uint8, by camera name; metres are shown as grey levels.

    Raises:
        CommandError: if there is no dataset in `folder` or no such frame in it.
    """
    if not (folder / "meta" / "info.json").is_file():
        raise CommandError(f"no dataset at {folder}: check --dataset.repo_id and --dataset.root")
    from lerobot.datasets import LeRobotDataset

    dataset = LeRobotDataset("local/preview", root=folder, depth_output_unit="m")
    if not 0 <= index < len(dataset):
        raise CommandError(f"--frame={index} is outside the dataset's {len(dataset)} frames")
    item = dataset[index]
    prefix = "observation.images."
    return {key.removeprefix(prefix): _as_rgb(item[key].numpy()) for key in dataset.meta.camera_keys}


def _as_rgb(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Turn (3, H, W) in [0, 1] or (1, H, W) metres into (H, W, 3) uint8; metres span black to white."""
    if len(image) == 3:
        return np.rint(image * 255).astype(np.uint8).transpose(1, 2, 0)
    low, high = float(image.min()), float(image.max())
    grey = np.rint(255 * (image[0] - low) / max(high - low, 1e-6)).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def montage(images: dict[str, NDArray[np.uint8]]) -> Image.Image:
    """Return one picture with every image in a row, enlarged and labelled."""
    width = len(images) * (TILE + GAP) + GAP
    sheet = Image.new("RGB", (width, TILE + LABEL + 2 * GAP), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(14)
    for i, (name, image) in enumerate(images.items()):
        left = GAP + i * (TILE + GAP)
        draw.text((left, GAP // 2), TITLES.get(name, name), fill="black", font=font)
        sheet.paste(Image.fromarray(image).resize((TILE, TILE), Image.Resampling.NEAREST), (left, LABEL + GAP // 2))
    return sheet


def preview(config: PreviewConfig) -> Path:
    """Write the picture that `config` describes and return its path."""
    images = frame_images(config.dataset.folder(), config.frame)
    wanted = config.images or [name for name in images if not name.endswith("_depth")]
    unknown = [name for name in wanted if name not in images]
    if unknown:
        raise ValueError(f"--images names {unknown}, the dataset has {sorted(images)}")
    config.output.parent.mkdir(parents=True, exist_ok=True)
    montage({name: images[name] for name in wanted}).save(config.output)
    logger.info("wrote %s", config.output)
    return config.output


def main() -> None:
    """Run the console command."""
    run_command(PreviewConfig, preview, EXAMPLES)
