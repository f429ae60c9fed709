"""Datasets whose joints become an end effector's state and action."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from lerobot_symview import keys
from lerobot_symview.datasets.derivation import Derivation, Derive
from lerobot_symview.datasets.features import Features, calibration_features
from lerobot_symview.datasets.image_statistics import ImageStatistics, vector_summary
from lerobot_symview.datasets.source import SourceDataset, vectors
from lerobot_symview.datasets.view_derivation import constant_columns, constant_summaries
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.state_reader import END_EFFECTOR
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.kinematics import Arm
from lerobot_symview.kinematics.arm import INCREMENT, STATE

ActionKind = Literal["increment", "target"]


@dataclass(frozen=True, kw_only=True)
class Conversion(Derivation):
    """Settings of a dataset whose joints are converted."""

    arm: Arm
    """What the joints move."""
    actions: ActionKind
    """`increment`, from the present pose to the target, or `target`, LeRobot's end effector."""
    horizon: int
    """Frames whose targets an increment reaches: 1 for those of its own frame."""
    cameras: dict[str, Camera]
    """Calibration that is added to the result."""
    keep: bool
    """Whether the joints are kept."""

    @property
    def columns(self) -> list[str]:
        """The joints and their targets."""
        return [keys.STATE, keys.ACTION]

    def deriver(self) -> Derive:
        """Return what converts the episodes of a part."""
        return self._convert

    def _convert(self, episode: int, table: pa.Table) -> tuple[dict[str, pa.Array], dict[str, ImageStatistics]]:
        """Return the new columns of an episode."""
        joints, targets = vectors(table, keys.STATE), vectors(table, keys.ACTION)
        columns = constant_columns(self.cameras, len(table))
        columns[keys.STATE] = _column(self.arm.states(joints))
        if self.actions == "target":
            columns[keys.ACTION] = _column(self.arm.end_effectors(targets))
        else:
            ahead = np.minimum(np.arange(len(table)) + self.horizon - 1, len(table) - 1)
            columns[keys.ACTION] = _column(self.arm.increments(joints, targets[ahead]))
        if self.keep:
            columns |= {keys.JOINTS: _column(joints), keys.JOINT_TARGETS: _column(targets)}
        return columns, {}

    def vector_summaries(self, episodes: list[pa.Table]) -> dict[str, list[dict[str, Any]]]:
        """Return the statistics of the new vectors."""
        summaries = constant_summaries(self.cameras, list(map(len, episodes)))
        for key in self.added:
            if key not in summaries:
                each = [vectors(table, key) for table in episodes]
                summaries[key] = [vector_summary(values) for values in (np.concatenate(each), *each)]
        return summaries


def _column(values: NDArray[np.floating]) -> pa.FixedSizeListArray:
    return pa.FixedSizeListArray.from_arrays(pa.array(values.astype(np.float32).ravel()), values.shape[1])


def converted_features(
    source: Features, arm: Arm, actions: ActionKind, workspace: Workspace, cameras: dict[str, Camera], keep: bool
) -> Features:
    """Declare the end effector's state and action, the calibration, and the joints if they are kept.

    `info["symview"]` of the state has the arm, by which a policy gives joints again, and the workspace.
    """
    names = END_EFFECTOR if actions == "target" else INCREMENT
    meaning = {"arm": arm.plain(), "workspace": asdict(workspace)}
    added: Features = {
        keys.STATE: _vector(STATE) | {"info": {"symview": meaning}},
        keys.ACTION: _vector(names),
    }
    for name, camera in cameras.items():
        has_lens, has_sensor = camera.lens is not None, camera.depth_sensor is not None
        added |= calibration_features(name, lens=has_lens, depth_sensor=has_sensor)
    if keep:
        added |= {keys.JOINTS: _vector(arm.state_names), keys.JOINT_TARGETS: _vector(arm.action_names)}
    declared = {key for key in added if key in source} - {keys.STATE, keys.ACTION}
    if declared:
        raise ValueError(f"the dataset already has {', '.join(sorted(declared))}")
    return added


def declared_images(source: Features, workspace: Workspace) -> Features:
    """Return the declarations of the cameras' images with the workspace, relative to which the state is."""
    changed: Features = {}
    for key, feature in source.items():
        if feature["dtype"] in ("image", "video"):
            info = feature.get("info") or {}
            meaning = info.get("symview", {}) | {"workspace": asdict(workspace)}
            changed[key] = feature | {"info": info | {"symview": meaning}}
    return changed


def _vector(names: tuple[str, ...]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": [len(names)], "names": list(names)}


def all_vectors(source: SourceDataset, key: str) -> NDArray:
    """Return a vector feature of all frames (N, D)."""
    import pyarrow.parquet as pq

    files = dict.fromkeys(source.data_file(episode) for episode in range(len(source.episodes)))
    return np.concatenate([vectors(pq.read_table(file, columns=[key]), key) for file in files])
