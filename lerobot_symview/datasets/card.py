"""The page that describes a dataset on the Hub, written from what the dataset says of itself."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_symview import keys
from lerobot_symview.datasets.source import EpisodeTables, SourceDataset, is_depth_feature

CARD, PICTURE = "README.md", "meta/symview_picture.png"
SHOWN_FRAME = 2  # of the first episode: the gripper is on its way, the arm in the picture
HEIGHT = 228  # pixels of the picture
TAGS = ("LeRobot", "symview", "robotics", "equivariance")
REPOSITORY = "lerobot_symview"


def write_card(folder: Path, repo_id: str, tags: list[str]) -> None:
    """Write the card of the dataset in `folder`, and its picture."""
    dataset = SourceDataset(folder)
    shown = _colour_images(dataset)
    if shown:
        cv2.imwrite(str(folder / PICTURE), cv2.cvtColor(np.concatenate(shown, axis=1), cv2.COLOR_RGB2BGR))
    (folder / CARD).write_text(dataset_card(dataset, repo_id, tags, has_picture=bool(shown)))


def dataset_card(dataset: SourceDataset, repo_id: str, tags: list[str], has_picture: bool) -> str:
    """Return the card: metadata as the Hub reads it, then Markdown."""
    info = dataset.info
    facts = _facts(dataset)
    title = facts.get("task", repo_id.split("/")[1]).replace("_", " ")
    sections = [
        _metadata([*TAGS, *tags]),
        f"# {title.capitalize()}, seen by freely placed cameras\n",
        f"{info['total_episodes']} episodes, {info['total_frames']} frames at {info['fps']} Hz, LeRobot format "
        f"{info['codebase_version']}.{_recorded(facts)}\n",
        f"![One moment]({PICTURE})\n" if has_picture else "",
        "## Images\n\n| key | pixels | what |\n|---|---|---|",
        *(_image_row(key, feature) for key, feature in dataset.features.items() if _is_image(feature)),
        _calibration(dataset),
        "\n## State and action\n",
        _entries(dataset, keys.STATE),
        _entries(dataset, keys.ACTION),
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


def _facts(dataset: SourceDataset) -> dict[str, Any]:
    """Return what is known of the recording, from any of its images."""
    found: dict[str, Any] = {}
    for feature in dataset.features.values():
        found |= (feature.get("info") or {}).get("symview", {})
    recording = dataset.folder / "meta" / "symview_recording.json"
    if recording.is_file():
        request = json.loads(recording.read_text())
        found |= {"task": request["env"]["task"], "robot": request["env"]["robot"], "seed": request["seed"]}
        found |= {"instruction": request["instruction"], "noise": request["noise"]}
    return found


def _recorded(facts: dict[str, Any]) -> str:
    if "task" not in facts:
        return ""
    sentences = [
        f"A scripted expert does `{facts['task']}` with a {facts['robot']} arm in PyBullet, seed {facts['seed']}."
    ]
    if "instruction" in facts:
        sentences.append(f'The instruction is "{facts["instruction"]}"')
    if facts.get("noise"):
        share = f"{facts['noise']:g} of the largest"
        sentences.append(f"Its motions are disturbed by {share}; what is recorded is what it meant to do.")
    if "expert_success_rate" in facts:
        rate = f"{100 * facts['expert_success_rate']:.1f} %"
        sentences.append(f"It succeeded in {rate} of its attempts; only successes are here.")
    return " " + " ".join(sentences)


def _image_row(key: str, feature: dict[str, Any]) -> str:
    height, width, _ = feature["shape"]
    symview = (feature.get("info") or {}).get("symview", {})
    unit = (feature.get("info") or {}).get("depth_unit")
    if "view" in symview:
        options = ", ".join(f"{name}={value}" for name, value in symview["options"].items())
        text = f"view `{symview['view']}` made from camera `{symview['camera']}` ({options})"
    elif "placement" in symview:
        place = symview["placement"]
        angle, distance = f"{place['elevation_deg']:g} degrees", f"{place['distance']:g} m"
        text = f"camera `{place['name']}`, {angle} above the table, {distance} away"
        if any(place["spread"].values()):
            text += ", elsewhere in every episode"
    else:
        text = "camera"
    measure = f", {'height' if 'view' in symview else 'depth'} in {unit}" if unit else ""
    return f"| `{key}` | {height} x {width} | {text}{measure} |"


def _calibration(dataset: SourceDataset) -> str:
    known = [key for key in dataset.features if key.startswith("observation.camera.")]
    if not known:
        return ""
    return (
        "\nEvery frame has its cameras' calibration: `intrinsics`, K in pixels (9 numbers, row by row), and "
        "`world_from_cam` (16 numbers, row by row), which maps points of the camera (x right, y down, z forward, "
        "metres) to the world (z up, table at z = 0). Integer pixel coordinates are pixel centres; depth is in metres "
        "along the optical axis, 0 where there is none. In views from above, rows grow with the world's x and columns "
        "with y.\n"
    )


def _entries(dataset: SourceDataset, key: str) -> str:
    feature = dataset.features.get(key)
    if feature is None:
        return ""
    names = feature.get("names")
    return f"`{key}`: {', '.join(names) if isinstance(names, list) else f'{feature["shape"][0]} numbers'}.\n"


def _training(repo_id: str, dataset: SourceDataset) -> str:
    views = [(feature.get("info") or {}).get("symview", {}).get("view") for feature in dataset.features.values()]
    view = next((one for one in views if one), None)
    method = f" --policy.method={view}_equi" if view else ""
    command = f"lerobot-train --dataset.repo_id={repo_id} --policy.type=symview_bc{method} --policy.push_to_hub=false"
    return (
        f"## Train on it\n\n```bash\n{command}\n```\n\n`symview_bc` is a policy of {REPOSITORY}, a plugin of LeRobot; "
        "other policies read the dataset too.\n"
    )


def _is_image(feature: dict[str, Any]) -> bool:
    return feature["dtype"] in ("image", "video")


def _colour_images(dataset: SourceDataset) -> list[NDArray[np.uint8]]:
    """Return a moment's colour images, all of one height."""
    names = [key for key, one in dataset.features.items() if _is_image(one) and not is_depth_feature(one)]
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
