"""Depth and height images of observations, brought to metres from the unit in which they arrive."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_policy_symview.inputs.observed_camera import ObservedCamera
from lerobot_symview import keys
from lerobot_symview.datasets.features import declared_unit
from lerobot_symview.geometry.units import (
    ABOVE_MINIMUM,
    METRES,
    MILLIMETRES,
    VIDEO_MINIMUM,
    infer_depth_unit,
    infer_height_unit,
    unit_name,
    units_per_metre,
)
from lerobot_symview.geometry.workspace import Workspace

logger = logging.getLogger(__name__)

IN_METRES = "observation.depth_in_metres"  # marks observations whose depth is in metres already


class DepthReader:
    """Converts depth to metres.

    A unit that is not given is, for the depth of a camera, the one that shows the table at z = 0; else it is inferred
    from the values. What is inferred is logged once.

    Args:
        given: feature -> metres per unit.
        cameras: name -> camera whose table tells the unit.
        workspace: the square on the table.
    """

    def __init__(self, given: Mapping[str, float], cameras: Mapping[str, ObservedCamera], workspace: Workspace):
        self._given, self._cameras, self._workspace = given, cameras, workspace
        self._table_units: dict[tuple[str, torch.dtype], float] = {}
        self._logged: set[tuple[str, float]] = set()
        self.units: dict[str, float] = {}
        """Feature -> metres per unit of the last observation."""

    def in_metres(self, observation: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the observation with all depth and height images in float metres; a second call changes nothing."""
        if IN_METRES in observation:
            return observation
        images = {
            key: values.detach()
            for key, values in observation.items()
            if key.startswith(keys.IMAGES) and key.endswith(("_depth", "_height"))
        }
        if not images:
            return observation
        self.units = {key: self._unit(key, values, observation) for key, values in images.items()}
        converted = {key: _metres(values, self.units[key]) for key, values in images.items()}
        converted |= {key: _without_minimum(depth) for key, depth in converted.items() if key.endswith("_depth")}
        return {**observation, **converted, IN_METRES: torch.ones(())}

    def _unit(self, key: str, values: Tensor, observation: Mapping[str, Tensor]) -> float:
        unit = self._given.get(key) or self._table_units.get((key, values.dtype))
        if unit is not None:
            return unit
        camera = self._cameras.get(key.removeprefix(keys.IMAGES).removesuffix("_depth"))
        if camera is not None and (unit := self._unit_by_table(camera, values, observation)) is not None:
            self._table_units[key, values.dtype] = unit
            logger.info("%s declares no unit: the table at z = 0 shows %s", key, unit_name(unit))
            return unit
        unit = (infer_height_unit if key.endswith("_height") else infer_depth_unit)(values)
        if values.is_floating_point() and (key, unit) not in self._logged:
            self._logged.add((key, unit))
            logger.info("%s declares no unit: its values are taken to be %s", key, unit_name(unit))
        return unit

    def _unit_by_table(self, camera: ObservedCamera, depth: Tensor, observation: Mapping[str, Tensor]) -> float | None:
        from lerobot_symview.calibration.table_plane import likely_depth_unit

        color = observation.get(keys.rgb(camera.name))
        if camera.missing_matrices(observation) or not depth.numel() or color is None:
            return None
        first = camera.cameras(observation)[0]
        if first.depth_sensor is None and depth.shape[-2:] != color.shape[-2:]:
            return None  # `aligned_depth` rejects it
        height, width = depth.shape[-2:]
        image = depth[0].reshape(height, width).cpu().numpy()
        return likely_depth_unit(image, first.depth_camera(height, width), self._workspace)


def delivered_units(meta: Any) -> dict[str, float]:
    """Return the metres per unit in which LeRobot's loader delivers each depth feature that declares its unit.

    The loader converts to `--dataset.depth_output_unit`, which it does not pass on; it rescales the statistics to the
    same unit, so these tell (`LeRobotDatasetMetadata.rescale_depth_stats`).

    Args:
        meta: of the `LeRobotDataset`.
    """
    from lerobot.datasets.io_utils import load_stats

    stored_stats = load_stats(meta.root) or {}
    units: dict[str, float] = {}
    for key in meta.depth_keys:
        unit = declared_unit(meta.features[key])
        if unit is None or key not in stored_stats or key not in (meta.stats or {}):
            continue
        same = np.allclose(meta.stats[key]["max"], stored_stats[key]["max"])
        units[key] = unit if same else (METRES if unit == MILLIMETRES else MILLIMETRES)
    return units


def _metres(depth: Tensor, unit: float) -> Tensor:
    depth = depth if depth.is_floating_point() else depth.float()
    # By a tensor: by a plain number a GPU may multiply with the rounded reciprocal, which rounds differently.
    return depth if unit == METRES else depth / depth.new_full((), units_per_metre(unit))


def _without_minimum(depth: Tensor) -> Tensor:
    """Return depth in metres with 0 for the pixels that LeRobot's depth videos clip to their minimum."""
    is_lost = (depth - VIDEO_MINIMUM).abs() <= VIDEO_MINIMUM * (ABOVE_MINIMUM - 1)
    return torch.where(is_lost, torch.zeros_like(depth), depth)
