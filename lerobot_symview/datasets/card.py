"""Dataset card for the Hub, generated from the dataset's metadata."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_symview import keys
from lerobot_symview.datasets.features import is_depth_feature
from lerobot_symview.datasets.metadata import RECORDING, read_settings
from lerobot_symview.datasets.source import EpisodeTables, SourceDataset

CARD, IMAGE = "README.md", "meta/symview_image.png"
SHOWN_FRAME = 2  # index in the first episode: the arm is in the image and the gripper moves
SHOWN_TASKS = 5  # instructions that are listed
HEIGHT = 228  # rows of the card's image
TAGS = ("LeRobot", "symview", "robotics", "equivariance")
REPOSITORY = "lerobot_symview"
LENS = (
    "\n`distortion` is the camera's lens (9 numbers): its model, 0 none, 1 `plumb_bob`, 2 `rational_polynomial`, 3 "
    "`equidistant` (OpenCV's fisheye), then the model's coefficients in OpenCV's order and zeros. The images are "
    "distorted.\n"
)

DEPTH_SENSOR = (
    "\nDepth is not aligned with colour: `depth_intrinsics` is the depth sensor's K, and `color_from_depth` maps its "
    "coordinates to those of the colour camera, metres.\n"
)


def write_card(folder: Path, repo_id: str, tags: list[str]) -> None:
    """Write the card of the dataset in `folder`, and its image."""
    dataset = SourceDataset(folder)
    shown = _colour_images(dataset)
    if shown:
        cv2.imwrite(str(folder / IMAGE), cv2.cvtColor(np.concatenate(shown, axis=1), cv2.COLOR_RGB2BGR))
    (folder / CARD).write_text(dataset_card(dataset, repo_id, tags, has_image=bool(shown)))


def dataset_card(dataset: SourceDataset, repo_id: str, tags: list[str], has_image: bool) -> str:
    """Return the card: YAML metadata for the Hub, then Markdown."""
    info = dataset.info
    recording = read_settings(dataset.folder, RECORDING)
    title = recording["env"]["task"] if recording else repo_id.split("/")[1]
    placements = _placements(recording)
    sections = [
        _metadata([*TAGS, *tags]),
        f"# {title.replace('_', ' ').capitalize()}, recorded by freely placed cameras\n",
        f"{info['total_episodes']} episodes, {info['total_frames']} frames at {info['fps']} Hz, LeRobot format "
        f"{info['codebase_version']}.{_recorded(recording)}{_instructions(dataset)}\n",
        f"![Images of one frame]({IMAGE})\n" if has_image else "",
        "## Images\n\n| key | pixels | content |\n|---|---|---|",
        *(
            _image_row(key, feature, placements.get(key))
            for key, feature in dataset.features.items()
            if _is_image(feature)
        ),
        _calibration(dataset),
        "\n## State and action\n",
        _dimensions(dataset, keys.STATE),
        _dimensions(dataset, keys.ACTION),
        "x and y are relative to the workspace's centre; lengths in metres, angles in radians, apertures in [0, 1].\n",
        _training(repo_id, dataset),
    ]
    return "\n".join(section for section in sections if section) + "\n"


def _metadata(tags: list[str]) -> str:
    from huggingface_hub import DatasetCardData

    data = DatasetCardData(
        license="apache-2.0",
        task_categories=["robotics"],
        tags=list(dict.fromkeys(tags)),
        configs=[{"config_name": "default", "data_files": "data/*/*.parquet"}],
    )
    return f"---\n{data.to_yaml()}\n---\n"


def _recorded(recording: dict[str, Any]) -> str:
    if not recording:
        return ""
    env = recording["env"]
    sentences = [
        f"A scripted expert performs `{env['task']}` with a {env['robot']} arm in PyBullet, seed {recording['seed']}."
    ]
    if env.get("style") == "human":
        sentences.append("It moves as people do, each episode in a style of its own (`symview_style` in its metadata).")
    if recording["noise"]:
        deviation = f"a standard deviation of {recording['noise']:g} of the largest action"
        sentences.append(f"Noise with {deviation} is added to its actions; the recorded actions are without noise.")
    if "expert_success_rate" in recording:
        rate = f"{100 * recording['expert_success_rate']:.1f} %"
        sentences.append(f"It succeeded in {rate} of its attempts; the dataset holds the successful ones only.")
    return " " + " ".join(sentences)


def _instructions(dataset: SourceDataset) -> str:
    instructions = sorted({task for row in dataset.episodes for task in row.get("tasks") or []})
    if not instructions:
        return ""
    more = f" and {len(instructions) - SHOWN_TASKS} more" if len(instructions) > SHOWN_TASKS else ""
    return f" Instructions: {', '.join(f'"{text}"' for text in instructions[:SHOWN_TASKS])}{more}."


def _placements(recording: dict[str, Any]) -> dict[str, Any]:
    """Return the placement of the camera that recorded each image, by feature key."""
    if not recording:
        return {}
    specs = [recording["env"]["camera"], *recording["env"]["more_cameras"]]
    return {key(spec["name"]): spec for spec in specs for key in (keys.rgb, keys.depth, keys.segmentation)}


def _image_row(key: str, feature: dict[str, Any], placement: dict[str, Any] | None) -> str:
    height, width, _ = feature["shape"]
    meaning = (feature.get("info") or {}).get("symview", {})
    unit = (feature.get("info") or {}).get("depth_unit")
    if "view" in meaning:
        options = ", ".join(f"{name}={value}" for name, value in meaning["options"].items())
        text = f"view `{meaning['view']}` made from camera `{meaning['camera']}` ({options})"
    elif placement is not None:
        angle, distance = f"{placement['elevation_deg']:g} degrees", f"{placement['distance']:g} m"
        text = f"camera `{placement['name']}`, {angle} above the table, {distance} away"
        if any(placement["spread"].values()):
            text += ", randomised in every episode"
    else:
        text = "camera"
    measure = f", {'height' if 'view' in meaning else 'depth'} in {unit}" if unit else ""
    return f"| `{key}` | {height} x {width} | {text}{measure} |"


def _calibration(dataset: SourceDataset) -> str:
    known = [key for key in dataset.features if key.startswith(keys.CALIBRATIONS)]
    if not known:
        return ""
    return (
        "\nEvery frame has its cameras' calibration: `intrinsics`, K in pixels (9 numbers, row-major), and "
        "`world_from_cam` (16 numbers, row-major), which maps camera coordinates (x right, y down, z forward, "
        "metres) to world coordinates (z up, table at z = 0). Integer pixel coordinates are pixel centres; depth is in "
        "metres along the optical axis, 0 where it is invalid. In top-down views, rows grow with the world's x and "
        "columns with y.\n"
        + (LENS if any(key.endswith(".distortion") for key in known) else "")
        + (DEPTH_SENSOR if any(key.endswith(".color_from_depth") for key in known) else "")
    )


def _dimensions(dataset: SourceDataset, key: str) -> str:
    feature = dataset.features.get(key)
    if feature is None:
        return ""
    names = feature.get("names")
    return f"`{key}`: {', '.join(names) if isinstance(names, list) else f'{feature["shape"][0]} numbers'}.\n"


def _training(repo_id: str, dataset: SourceDataset) -> str:
    views = [(feature.get("info") or {}).get("symview", {}).get("view") for feature in dataset.features.values()]
    view = next((name for name in views if name), None)
    method = f" --policy.method={view}_equi" if view else ""
    command = f"lerobot-train --dataset.repo_id={repo_id} --policy.type=symview_bc{method} --policy.push_to_hub=false"
    return (
        f"## Train on it\n\n```bash\n{command}\n```\n\n`symview_bc` is a policy of {REPOSITORY}, a plugin of LeRobot; "
        "other LeRobot policies can train on this dataset too.\n"
    )


def _is_image(feature: dict[str, Any]) -> bool:
    return feature["dtype"] in ("image", "video")


def _colour_images(dataset: SourceDataset) -> list[NDArray[np.uint8]]:
    """Return the colour images of one frame, resized to the same number of rows."""
    names = [key for key, feature in dataset.features.items() if _is_image(feature) and not is_depth_feature(feature)]
    names = [key for key in names if not key.endswith(("_segmentation", "_gripper", "_seen"))]
    stored = [key for key in names if dataset.features[key]["dtype"] == "image"]
    reader = EpisodeTables(dataset, dataset.data_file(0), [*stored, "timestamp"])
    table = reader.read(0)
    row = table.slice(min(SHOWN_FRAME, len(table) - 1), 1)
    images = [next(dataset.images(key, 0, row)) for key in names]
    return [
        cv2.resize(image, (image.shape[1] * HEIGHT // image.shape[0], HEIGHT), interpolation=cv2.INTER_NEAREST)
        for image in images
    ]
