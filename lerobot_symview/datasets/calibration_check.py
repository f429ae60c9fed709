"""Checks of a dataset's calibration and depth unit against its images, before views are rendered."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace

from lerobot_symview import keys
from lerobot_symview.calibration.agreement import report_agreement
from lerobot_symview.calibration.table_plane import TablePlane, check_table, has_depth, likely_depth_unit
from lerobot_symview.datasets.features import declared_unit
from lerobot_symview.datasets.frame_reader import FrameReader
from lerobot_symview.errors import CalibrationError, DatasetError
from lerobot_symview.geometry.units import METRES, unit_name
from lerobot_symview.geometry.visibility import LEAST_VISIBLE, MINIMUM_VISIBLE, check_camera
from lerobot_symview.views import Frame

logger = logging.getLogger(__name__)


def with_depth_units(reader: FrameReader, depth_unit: float | None) -> FrameReader:
    """Return the reader with the unit of every camera's depth, metres per unit.

    The unit is the argument, else the calibration file's, else the one that the dataset declares. Where none is stated,
    it is the unit in which the first depth image shows the table at z = 0, which is logged; if the table is hidden, the
    reader infers the unit from the values.
    """
    units = {name: _depth_unit(one, depth_unit) for name, one in _by_camera(reader).items() if one.depth}
    return replace(reader, depth_units={name: unit for name, unit in units.items() if unit is not None})


def _depth_unit(reader: FrameReader, depth_unit: float | None) -> float | None:
    key = keys.depth(reader.camera)
    feature = reader.dataset.features[key]
    unit = depth_unit or (reader.calibration.depth_units.get(reader.camera) if reader.calibration else None)
    if unit is None and feature["dtype"] == "image" and declared_unit(feature) is None:
        unit = _unit_by_table(reader, key)
    return unit


def _by_camera(reader: FrameReader) -> dict[str, FrameReader]:
    """Return the reader and those of the cameras that views merge with its camera, by name."""
    return {reader.camera: reader, **reader.others}


def check_calibration(reader: FrameReader) -> TablePlane | None:
    """Check every camera and its depth in the first frame of the first, middle and last episode.

    A warning is logged if two cameras that a view merges measure different heights, which the calibration of at least
    one of them explains.

    Returns:
        The table's plane in the first of these frames of the reader's camera that shows it.

    Raises:
        CalibrationError: if a camera is below the table, shows the workspace in too few pixels, sees less than 10 % of
            it, or 60 % with a fixed calibration, or if depth shows the table elsewhere than at z = 0.
        DatasetError: if no frame has a valid depth pixel in the workspace.
    """
    frames = _first_frames(reader)
    planes = [_check_camera(reader, frames)]
    for name, other in reader.others.items():
        planes.append(_check_camera(other, {episode: frame.others[name] for episode, frame in frames.items()}))
    frame = next(iter(frames.values()))
    merged = {reader.camera: frame, **frame.others}
    depths = {name: one.depth for name, one in merged.items() if one.depth is not None}
    if len(depths) > 1:
        cameras = {name: one.camera for name, one in merged.items()}
        report_agreement(depths, cameras, reader.workspace, frame.gripper_height)
    return planes[0]


def _check_camera(reader: FrameReader, frames: Mapping[int, Frame]) -> TablePlane | None:
    for episode, frame in frames.items():
        minimum = MINIMUM_VISIBLE if reader.given_camera is not None else LEAST_VISIBLE
        try:
            check_camera(reader.camera, frame.camera, reader.workspace, minimum=minimum)
        except CalibrationError as error:
            raise CalibrationError(f"episode {episode}: {error}") from None
    visible = min(reader.workspace.visible_fraction(frame.camera) for frame in frames.values())
    if visible < MINIMUM_VISIBLE:
        logger.warning(
            "camera %r sees %.0f %% of the workspace: views will be empty outside its image",
            reader.camera,
            100 * visible,
        )
    return _check_tables(reader, frames) if reader.depth else None


def _check_tables(reader: FrameReader, frames: Mapping[int, Frame]) -> TablePlane | None:
    key = keys.depth(reader.camera)
    is_video = reader.dataset.features[key]["dtype"] == "video"
    unit = METRES if is_video else reader.depth_unit or reader.dataset.depth_unit(key)
    planes = []
    for episode, frame in frames.items():
        if frame.depth is None or not has_depth(frame.depth, frame.camera, frame.workspace):
            continue
        try:
            planes.append(check_table(frame.depth, frame.camera, frame.workspace, unit))
        except CalibrationError as error:
            raise CalibrationError(f"episode {episode}, {key}: {error}") from None
    if not planes:
        raise DatasetError(f"{key} has no valid pixel in the workspace, in the first frame of episodes {[*frames]}")
    visible = [plane for plane in planes if plane is not None]
    if not visible:
        logger.warning("%s does not show the table: its unit and the camera's pose are not checked", key)
        return None
    if visible[0].deviates:
        logger.warning("%s: %s; check the calibration", key, visible[0])
    return visible[0]


def _first_frames(reader: FrameReader) -> dict[int, Frame]:
    """Return episode -> its first frame, for the first, the middle and the last episode."""
    count = len(reader.dataset.episodes)
    return {episode: reader.frame(episode, 0) for episode in sorted({0, count // 2, count - 1})}


def _unit_by_table(reader: FrameReader, key: str) -> float | None:
    stored = reader.dataset.first_depth(key)
    if stored is None:
        return None
    index, depth = stored
    camera = replace(reader, views=()).frame(0, index).camera
    unit = likely_depth_unit(depth, camera.depth_camera(*depth.shape), reader.workspace)
    if unit is not None:
        logger.info("%s declares no depth_unit: the table at z = 0 shows %s", key, unit_name(unit))
    return unit
