"""Comparison of a camera's image with one of the demonstrations, before a policy acts (`--policy.check_camera`)."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_calibration, parse_workspace
from lerobot_symview.errors import CalibrationError

logger = logging.getLogger(__name__)

REFERENCE = "reference_image"  # name of the policy's buffer


def reference_image(config: SymviewConfig) -> Tensor:
    """Return the camera's first image in the training dataset, (H, W, 3) uint8; zeros where there is no dataset.

    Raises:
        ValueError: if the dataset lacks the camera's images, or its camera was moved.
    """
    from lerobot_symview.datasets.frame_reader import FrameReader  # slow imports: pyarrow
    from lerobot_symview.datasets.source import SourceDataset

    key = keys.rgb(config.seen_camera)
    meta: Any = getattr(config, "_runtime_dataset_meta", None)  # set by LeRobot before it makes the policy
    if meta is None:
        channels, height, width = (config.input_features or {})[key].shape
        return torch.zeros(height, width, channels, dtype=torch.uint8)
    name = next(iter(config.substitutes(meta.features)), config.seen_camera)
    if keys.rgb(name) not in meta.features or not config.camera_calibration:
        raise ValueError(
            f"--policy.check_camera compares images of the camera {name!r} with those of the demonstrations: they must "
            f"have {keys.rgb(name)!r}, and one calibration of it in all frames"
        )
    reader = FrameReader(SourceDataset(Path(meta.root)), name, parse_workspace(config.workspace), views=())
    return torch.from_numpy(reader.frame(0, 0).rgb.copy())


def with_reference(state: Mapping[str, Any], own: Tensor | None) -> dict[str, Any]:
    """Return a policy's stored state with the image to compare with, or without one.

    Args:
        state: the stored state.
        own: (H, W, 3) uint8, the training dataset's image, which takes precedence in fine-tuning, or zeros; None where
            the policy compares nothing.

    Raises:
        ValueError: if there is no image.
    """
    others = {name: value for name, value in state.items() if name != REFERENCE}
    if own is None:
        return others
    image = own if own.any() else state.get(REFERENCE)
    if image is None or not image.any():
        raise ValueError("--policy.check_camera needs a policy that was trained with --policy.check_camera=true")
    return {**others, REFERENCE: image}


def check_observation(config: SymviewConfig, reference: Tensor, observation: Mapping[str, Tensor]) -> None:
    """Warn of a camera that was moved since the demonstrations.

    Args:
        config: the policy's configuration, with the camera's calibration.
        reference: (H, W, 3) uint8, of the demonstrations.
        observation: has the camera's images (B, 3, H, W), float in [0, 1] or uint8; the first is compared.

    Raises:
        KeyError: if it has not.
        CalibrationError: if the image shows something else: the lens is covered, it is another camera, or it was moved
            far.
    """
    from lerobot_symview.calibration.drift import MOST_DRIFT, image_drift

    key = keys.rgb(config.seen_camera)
    if key not in observation:
        raise KeyError(f"--policy.check_camera needs {key!r}, the observation has {sorted(observation)}")
    image = observation[key][0]
    pixels = image if image.dtype == torch.uint8 else (image * 255).round().to(torch.uint8)
    camera = parse_calibration(config.camera_calibration).camera(config.camera)
    try:
        drift = image_drift(reference.cpu().numpy(), pixels.permute(1, 2, 0).contiguous().cpu().numpy())
    except CalibrationError as error:
        raise CalibrationError(
            f"the camera {config.seen_camera!r} does not show what it showed in the demonstrations: {error}; check its "
            "lens and its name, and calibrate it again if it was moved (--policy.check_camera=false skips this)"
        ) from None
    length = drift.described(camera, parse_workspace(config.workspace))
    moved = f"since the demonstrations the image of camera {config.seen_camera!r} has moved by {length}"
    if drift.pixels > MOST_DRIFT:
        logger.warning(
            "%s: move it back; or calibrate it again, give --policy.calibration, and skip this with "
            "--policy.check_camera=false",
            moved,
        )
    else:
        logger.info("%s", moved)
