"""Reading and validation of a dataset's metadata: paths stay in the dataset, sizes are bounded.

    meta/info.json                  LeRobot's; a feature's `info["symview"]` says what its values mean
    meta/symview_recording.json     settings of a simulated recording and its expert's success rate, optional
    meta/symview_views.json         settings of `symview-add-views`, optional
    meta/symview_conversion.json    settings of `symview-convert-actions`, optional
    meta/episodes/*/*.parquet       LeRobot's; `symview_style` is how each episode was demonstrated, JSON, optional

LeRobot merges only datasets whose features are equal. Hence the features hold nothing that may differ between
recordings: the calibration is in columns, the rest in our own files, which LeRobot's tools do not copy.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from lerobot_symview.errors import DatasetError

FORMAT = "v3.0"  # LeRobot's dataset format
MOST_PIXELS = 2**26  # largest size of an image
COUNTS = {"total_episodes": 0, "total_frames": 0, "chunks_size": 1}  # least values
NUMBERS = r"\{(?:chunk|file)_index(?::0[1-9]d)?\}"
TEMPLATES = {"data_path": NUMBERS, "video_path": rf"{NUMBERS}|\{{video_key\}}"}
RECORDING, ADDED_VIEWS, CONVERSION = "symview_recording.json", "symview_views.json", "symview_conversion.json"
EPISODE_STYLE = "symview_style"  # column of the episodes' metadata


def read_info(folder: Path) -> dict[str, Any]:
    """Return the validated content of a dataset's `meta/info.json`.

    Raises:
        DatasetError: if the file is missing, has another format or is invalid; one message lists all problems.
    """
    file = folder / "meta" / "info.json"
    if not file.is_file():
        raise DatasetError(f"there is no LeRobot dataset in {folder}")
    info = _read_object(file)
    version = info.get("codebase_version")
    if version != FORMAT:
        raise DatasetError(f"the dataset at {folder} has format {version}, expected {FORMAT}: convert it with LeRobot")
    problems = list(_problems(info))
    if problems:
        raise DatasetError(f"{file}: {'; '.join(problems)}")
    return info


def read_settings(folder: Path, name: str) -> dict[str, Any]:
    """Return the content of a dataset's file `name`, such as `RECORDING`; {} if the dataset lacks it.

    Raises:
        DatasetError: if the file is not a JSON object.
    """
    file = folder / "meta" / name
    return _read_object(file) if file.is_file() else {}


def episode_styles(episodes: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return how each episode was demonstrated; {} where the dataset does not say.

    Args:
        episodes: rows of `meta/episodes`, such as `SourceDataset.episodes` or `LeRobotDataset.meta.episodes`.

    Raises:
        DatasetError: if a style is not a JSON object.
    """
    return [_style(row.get(EPISODE_STYLE)) for row in episodes]


def _style(text: Any) -> dict[str, Any]:
    if text is None:
        return {}
    try:
        style = json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise DatasetError(f"cannot read an episode's {EPISODE_STYLE} {str(text)[:200]!r}: {error}") from None
    if not isinstance(style, dict):
        raise DatasetError(f"an episode's {EPISODE_STYLE} must hold an object, got {type(style).__name__}")
    return style


def _read_object(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text())
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"cannot read {file}: {error}") from None
    if not isinstance(content, dict):
        raise DatasetError(f"{file} must hold an object, got {type(content).__name__}")
    return content


def _problems(info: dict[str, Any]) -> Iterator[str]:
    for name, least in COUNTS.items():
        if not is_count(info.get(name), least):
            yield f"{name} must be an integer of at least {least}, got {info.get(name)!r}"
    for name, fields in TEMPLATES.items():
        template = info.get(name)
        if (name == "data_path" or template is not None) and not _stays_inside(template, fields):
            yield f"{name} must be a relative path in the dataset, such as LeRobot's own, got {str(template)[:200]!r}"
    features = info.get("features")
    if not isinstance(features, dict):
        yield f"features must be an object, got {type(features).__name__}"
        return
    for key, feature in features.items():
        yield from (f"the feature {key!r} {problem}" for problem in _feature_problems(key, feature))


def _feature_problems(key: str, feature: Any) -> Iterator[str]:
    if not re.fullmatch(r"[^./\\\0][^/\\\0]*", key):  # video folders are named by the key
        yield "has a name that is not safe as a folder name"
    if not isinstance(feature, dict) or not isinstance(feature.get("dtype"), str):
        yield "must be an object with a dtype"
        return
    info = feature.get("info") or {}
    if not isinstance(info, dict) or not isinstance(info.get("symview", {}), dict):
        yield "has an info that is not an object"
    shape = feature.get("shape")
    if feature["dtype"] in ("image", "video") and (
        not isinstance(shape, list)
        or len(shape) != 3
        or not all(is_count(side, 1) for side in shape)
        or pixels(shape) > MOST_PIXELS
    ):
        yield f"must have a shape of three positive integers and at most {MOST_PIXELS} pixels, got {shape!r}"


def is_count(value: Any, least: int) -> bool:
    """Whether a value is an integer of at least `least`."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def pixels(shape: list[int]) -> int:
    """Return the number of pixels of a declared image shape, channels first or last."""
    _, *sides = sorted(shape)
    return sides[0] * sides[1]


def _stays_inside(template: Any, fields: str) -> bool:
    part = rf"(?:[\w.-]|{fields})+"
    if not isinstance(template, str) or not re.fullmatch(rf"{part}(?:/{part})*", template):
        return False
    return not {".", ".."} & set(template.split("/"))
