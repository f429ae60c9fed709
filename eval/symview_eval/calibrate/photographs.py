"""Images to calibrate a camera from: files, or frames of a LeRobot dataset."""

from __future__ import annotations

import glob
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_symview import keys
from lerobot_symview.datasets.features import is_depth_feature
from lerobot_symview.datasets.image_codec import decode_depth, decode_rgb
from lerobot_symview.datasets.source import EpisodeTables, SourceDataset
from lerobot_symview.errors import CalibrationError, DatasetError

Photographs = dict[str, NDArray[np.uint8]]
"""Name of an image -> (H, W, 3) uint8 RGB, in order."""
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


def from_files(pattern: str) -> Photographs:
    """Read images from a file, a folder or a pattern such as `photos/*.jpg`, by file name.

    Raises:
        CalibrationError: if there is none, or one is no image.
    """
    path = Path(pattern).expanduser()
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
    else:
        files = [path] if path.is_file() else sorted(map(Path, glob.glob(str(path))))
    if not files:
        raise CalibrationError(f"no image is at {pattern}; folders are searched for {', '.join(SUFFIXES)}")
    photographs = {}
    for file in files:
        try:
            photographs[file.name] = decode_rgb(file.read_bytes())
        except (OSError, ValueError) as error:
            raise CalibrationError(f"{file}: {error}") from None
    return photographs


def from_dataset(folder: Path, camera: str, episodes: list[int], frames: int) -> Photographs:
    """Read a camera's images from a dataset, `frames` of each episode, evenly spaced from its first.

    Raises:
        DatasetError: if the dataset lacks the camera or an episode.
    """
    source, key = SourceDataset(folder), keys.rgb(camera)
    if key not in source.features:
        known = [name.removeprefix(keys.IMAGES) for name in source.features if name.startswith(keys.IMAGES)]
        raise DatasetError(f"the dataset has no camera {camera!r}; it has {', '.join(known) or 'none'}")
    photographs = {}
    for episode in episodes:
        table = rows(source, key, episode)
        for name, index in chosen_frames(episode, len(table), frames).items():
            photographs[name] = next(source.images(key, episode, table.slice(index, 1)))
    return photographs


def depth_from_dataset(folder: Path, camera: str, episode: int, unit: float | None) -> NDArray[np.floating]:
    """Read the first depth image of an episode, (H, W) float32 metres, as `SourceDataset.images` does.

    Raises:
        DatasetError: if the dataset lacks the camera's depth or the episode.
    """
    source, key = SourceDataset(folder), keys.depth(camera)
    if not is_depth_feature(source.features.get(key, {})):
        raise DatasetError(f"the dataset has no depth feature {key}")
    return next(source.images(key, episode, rows(source, key, episode).slice(0, 1), unit))


def depth_from_file(file: Path) -> NDArray:
    """Read a depth image, (H, W), in the file's own unit, from an image of 16 or 32 bits or a NumPy file.

    Raises:
        CalibrationError: if it is none.
    """
    try:
        if file.suffix != ".npy":
            return decode_depth(file.read_bytes())
        depth = np.load(file)
    except (OSError, ValueError) as error:
        raise CalibrationError(f"{file}: {error}") from None
    if depth.ndim != 2:
        raise CalibrationError(f"{file}: expected depth of shape (height, width), got {depth.shape}")
    return depth


def chosen_frames(episode: int, length: int, frames: int) -> dict[str, int]:
    """Return name -> index of the frames of an episode that are used, evenly spaced from its first."""
    chosen = np.unique(np.arange(frames) * length // frames).tolist()
    return {f"episode {episode}, frame {index}": index for index in chosen}


def rows(source: SourceDataset, key: str, episode: int) -> Any:
    """Return the table of an episode, with the columns that reading the feature `key` needs."""
    if not 0 <= episode < len(source.episodes):
        raise DatasetError(f"the dataset has {len(source.episodes)} episodes, there is no episode {episode}")
    columns = ["timestamp"] + ([key] if source.features[key]["dtype"] != "video" else [])
    return EpisodeTables(source, source.data_file(episode), columns).read(episode)
