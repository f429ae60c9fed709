"""`symview-preview --check`: whether a dataset's camera was moved between its episodes, and where it stands now."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from tqdm import tqdm

from lerobot_symview.calibration.drift import MOST_DRIFT, Drift, image_drift, moved_camera
from lerobot_symview.calibration.file import Calibration, plain_calibration
from lerobot_symview.calibration.table_plane import has_depth, levelled
from lerobot_symview.datasets.frame_reader import FrameReader
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.visibility import table_resolution
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
    resolution = table_resolution(farthest.frame.camera, reader.workspace)
    length = f"{farthest.drift.pixels:.1f} pixels"
    if resolution > 0:
        length += f" (up to {farthest.drift.pixels / resolution:.1f} mm on the table)"
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
    _write_moved(reader, moved[-1], output_dir)
    return measured


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


def _write_moved(reader: FrameReader, moved: EpisodeDrift, output_dir: Path) -> None:
    try:
        camera = moved_camera(moved.frame.camera, moved.drift, moved.frame.depth)
    except CalibrationError as error:
        logger.warning("episode %d: %s", moved.episode, error)
        return
    difference = moved.frame.camera.cam_from_world @ camera.world_from_cam
    degrees = np.rad2deg(np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1)))
    frame = reader.frame(moved.episode, 0)
    plane = ""
    if frame.depth is not None and has_depth(frame.depth, camera, reader.workspace):
        try:
            plane = f"; with it, in the depth image, {levelled(frame.depth, camera, reader.workspace)[1]}"
        except CalibrationError as error:
            plane = f"; {error}"
    file = output_dir / "cameras.yaml"
    calibration = Calibration({reader.camera: camera}, reader.workspace)
    replace_file(file, yaml.safe_dump(plain_calibration(calibration), sort_keys=False, default_flow_style=None))
    logger.info(
        "wrote %s: the camera as it stands in episode %d, turned by %.2f degrees and shifted by %.1f mm%s",
        file,
        moved.episode,
        degrees,
        1000 * np.linalg.norm(difference[:3, 3]),
        plane,
    )
