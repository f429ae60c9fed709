"""`symview-preview --check`: whether a dataset's camera was moved between its episodes, and where it stands now.

`--check_image` and `--device` compare an image that the camera takes now.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from tqdm import tqdm

from lerobot_symview.calibration.drift import MOST_DRIFT, Drift, image_drift, moved_camera
from lerobot_symview.calibration.file import Calibration, plain_calibration
from lerobot_symview.calibration.table_plane import has_depth, levelled
from lerobot_symview.datasets.frame_reader import FrameReader
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.views import Frame
from symview_eval.calibrate.output import replace_file

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class EpisodeDrift:
    """How far an episode's first frame has moved since that of the reference, which has the same calibration."""

    episode: int
    reference: int
    """The first episode with the same calibration."""
    frame: Frame
    """The reference's frame."""
    drift: Drift


def check_drift(reader: FrameReader, output_dir: Path) -> list[EpisodeDrift]:
    """Compare the first frames of all episodes, report what has moved, and write the moved camera's calibration.

    Args:
        reader: of the camera's frames.
        output_dir: folder for `cameras.yaml`, written only if the camera was moved.

    Returns:
        What was measured; without the episodes whose images cannot be compared.
    """
    measured = _measured(reader)
    moved = [one for one in measured if one.drift.pixels > MOST_DRIFT]
    if not measured:
        logger.info("camera %r: every episode has a calibration of its own, there is nothing to compare", reader.camera)
        return measured
    farthest = max(measured, key=lambda one: one.drift.pixels)
    length = farthest.drift.described(farthest.frame.camera, reader.workspace)
    if not moved:
        logger.info(
            "camera %r stands still: its image moves by at most %s in %d episodes",
            reader.camera,
            length,
            len(measured) + 1,
        )
        return measured
    episodes = ", ".join(str(one.episode) for one in moved)
    logger.warning(
        "camera %r was moved since episode %d: its image by %s in episode %d, and by more than %g pixels in the "
        "episodes %s. Views of these episodes are displaced",
        reader.camera,
        farthest.reference,
        length,
        farthest.episode,
        MOST_DRIFT,
        episodes,
    )
    last = moved[-1]
    label, now = f"episode {last.episode}", reader.frame(last.episode, 0)
    _write_moved(reader, last.frame, last.drift, label, now.depth, output_dir)
    return measured


def check_image(reader: FrameReader, name: str, image: NDArray[np.uint8], output_dir: Path) -> Drift:
    """Compare an image that the camera takes now with the dataset, and report whether the camera was moved since.

    The reference is the first episode with the last episode's calibration, as in `check_drift`: the calibration is
    right there.

    Args:
        reader: of the camera's frames.
        name: of the image, for messages.
        image: (H, W, 3) uint8 RGB.
        output_dir: folder for `cameras.yaml`, written only if the camera was moved.

    Raises:
        CalibrationError: if the image shows something else.
    """
    count = len(reader.dataset.episodes)
    last = reader.frame(count - 1, 0)
    frames = ((index, reader.frame(index, 0)) for index in range(count))
    episode, frame = next((index, one) for index, one in frames if one.camera == last.camera)
    try:
        drift = image_drift(frame.rgb, image)
    except CalibrationError as error:
        raise CalibrationError(f"{name} cannot be compared with episode {episode}: {error}") from None
    length = drift.described(frame.camera, reader.workspace)
    if drift.pixels <= MOST_DRIFT:
        logger.info("camera %r stands still: %s is shifted by %s", reader.camera, name, length)
        return drift
    logger.warning(
        "camera %r was moved since episode %d: %s is shifted by %s. Views of new images are displaced",
        reader.camera,
        episode,
        name,
        length,
    )
    _write_moved(reader, frame, drift, name, None, output_dir)
    return drift


def _measured(reader: FrameReader) -> list[EpisodeDrift]:
    references: dict[Camera, tuple[int, Frame]] = {}
    measured = []
    for episode in tqdm(range(len(reader.dataset.episodes)), desc="check", unit="episode"):
        frame = reader.frame(episode, 0)
        first, reference = references.setdefault(frame.camera, (episode, frame))
        if first == episode:
            continue
        try:
            measured.append(EpisodeDrift(episode, first, reference, image_drift(reference.rgb, frame.rgb)))
        except CalibrationError as error:
            logger.warning("episode %d cannot be compared with episode %d: %s", episode, first, error)
    return measured


def _write_moved(
    reader: FrameReader,
    reference: Frame,
    drift: Drift,
    label: str,
    depth_now: NDArray[np.floating] | None,
    output_dir: Path,
) -> None:
    try:
        camera = moved_camera(reference.camera, drift, reference.depth)
    except CalibrationError as error:
        logger.warning("%s: %s", label, error)
        return
    difference = reference.camera.cam_from_world @ camera.world_from_cam
    degrees = np.rad2deg(np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1)))
    plane = ""
    if depth_now is not None and has_depth(depth_now, camera, reader.workspace):
        try:
            plane = f"; with it, in the depth image, {levelled(depth_now, camera, reader.workspace)[1]}"
        except CalibrationError as error:
            plane = f"; {error}"
    file = output_dir / "cameras.yaml"
    known = reader.states_calibration or Calibration({})
    calibration = replace(known, cameras={reader.camera: camera}, workspace=reader.workspace, depth_units={})
    replace_file(file, yaml.safe_dump(plain_calibration(calibration), sort_keys=False, default_flow_style=None))
    logger.info(
        "wrote %s: the camera as it stands in %s, turned by %.2f degrees and shifted by %.1f mm%s",
        file,
        label,
        degrees,
        1000 * np.linalg.norm(difference[:3, 3]),
        plane,
    )
