"""`symview-convert-actions`: turns a dataset of joints into one of an end effector's states and actions."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_symview import keys
from lerobot_symview.calibration.readings import PoseReading
from lerobot_symview.datasets.add_views import POSE_FLAGS, calibration_and_workspace, check_apart
from lerobot_symview.datasets.conversion import (
    ActionKind,
    Conversion,
    all_vectors,
    converted_features,
    declared_images,
)
from lerobot_symview.datasets.derivation import derived_schema, source_fingerprint, write_dataset
from lerobot_symview.datasets.features import image_size, names_of
from lerobot_symview.datasets.hub import HubDataset, push_dataset
from lerobot_symview.datasets.metadata import CONVERSION
from lerobot_symview.datasets.robot_flags import RobotFlags
from lerobot_symview.datasets.source import SourceDataset
from lerobot_symview.errors import CalibrationError, DatasetError
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.visibility import check_camera
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.kinematics import Arm, check_positions
from lerobot_symview.kinematics.pose import is_singular, tool_poses
from lerobot_symview.runtime.cli import DatasetLocation, check_repo_id, flagged, run_command
from lerobot_symview.runtime.executors import EXECUTORS
from lerobot_symview.runtime.staging import is_complete, partial_folder, plain

logger = logging.getLogger(__name__)

EXAMPLES = """\
  symview-convert-actions --dataset.repo_id=me/so101 --robot.preset=so101 --calibration=cameras.yaml
  symview-convert-actions --dataset.repo_id=me/so100 --robot.urdf=so100.urdf --robot.tool_frame=gripper_frame_link \\
      --robot.units=normalized --robot.motors=follower.json --calibration=cameras.yaml --keep=true
  symview-convert-actions --dataset.repo_id=me/arm --robot.urdf=arm.urdf --robot.tool_frame=tcp \\
      --robot.joints='{elbow: joint_3, jaw: finger}' --robot.gripper=jaw --robot.gripper_range='[0, 1.6]' \\
      --robot.units=radians --workspace.center='[0.3, 0]'"""


MOST_CHECKED = 100_000  # frames whose gripper is looked at before the conversion
BELOW = 0.03  # metres under the table at which the gripper cannot be


@dataclass(frozen=True)
class ConvertActionsConfig:
    """Turn a dataset of joint angles into one of an end effector's states and actions, in the table's frame.

    The state becomes x, y, z, yaw, aperture, tilt, and the action the increment from there to the target of the joints.
    The result is a new dataset; the source is not modified.
    """

    dataset: HubDataset
    """The source dataset, with named joints in state and action; the Hub options apply to the new dataset."""
    robot: RobotFlags = field(default_factory=RobotFlags)
    """The arm."""
    new_repo_id: str = ""
    """`user/name` of the new dataset; by default the source's with `_ee` appended."""
    new_root: Path | None = None
    """Folder of the new dataset; by default LeRobot's cache folder for `new_repo_id`."""
    calibration: Path | list[Path] | None = None
    """File with the cameras' calibration, and the pose of the robot's base in their world (`robot_base`); the
    calibration is added to the new dataset. Without a file, `workspace` is in the frame of the base."""
    camera: str = "side"
    """Camera of a calibration file of another tool, which names none."""
    pose: PoseReading = field(default_factory=PoseReading)
    """How to read the calibration's pose; by default as its file says, else as the reading that sees the workspace."""
    workspace: Workspace | None = None
    """Square on the table; by default that of the calibration file. The state's x and y are relative to its centre."""
    actions: ActionKind = "increment"
    """`increment` is for our policies: the way from the present pose to the target of the joints. `target` is LeRobot's
    ee.x, …: the pose at that target in the base's frame, for policies without symmetry."""
    horizon: int = 1
    """Frames that an increment reaches ahead: to the target of this frame (1), or of a later one."""
    keep: bool = False
    """Keep the joints and their targets, as observation.joints and observation.joint_targets."""
    num_workers: int = 1
    """Processes that convert in parallel. The result does not depend on their number."""
    resume: bool = False
    """Continue an interrupted run of the same command."""

    def __post_init__(self) -> None:
        if self.num_workers < 1:
            raise ValueError(f"--num_workers must be at least 1, got {self.num_workers}")
        if self.horizon < 1:
            raise ValueError(f"--horizon must be at least 1, got {self.horizon}")
        if self.horizon > 1 and self.actions == "target":
            raise ValueError(f"--horizon={self.horizon} is of increments, --actions=target has none")
        if self.calibration is None and self.workspace is None:
            raise ValueError(
                "give --calibration=cameras.yaml, with the workspace and the base of the robot, or the workspace's "
                "centre in the frame of the base, such as --workspace.center='[0.25, 0]'"
            )
        if self.new_repo_id:
            check_repo_id(self.new_repo_id, "--new_repo_id")

    def target(self) -> DatasetLocation:
        """Return the location of the new dataset."""
        return DatasetLocation(self.new_repo_id or f"{self.dataset.repo_id}_ee", self.new_root)


def convert_actions(config: ConvertActionsConfig) -> Path:
    """Write the dataset of `config`, upload it with `push_to_hub`, and return its folder.

    Columns other than state and action are bit-identical to the source's, images and videos included.
    """
    folder = _write(config)
    if config.dataset.push_to_hub:
        push_dataset(config.target(), config.dataset)
    return folder


def _write(config: ConvertActionsConfig) -> Path:
    with flagged("--dataset"):
        source = SourceDataset(config.dataset.folder())
        _check_source(source)
    target = config.target().folder()
    check_apart(source.folder, target)
    executor = EXECUTORS["local"](config.num_workers, Conversion.__module__)  # starts while this plans
    conversion = _plan(config, source, partial_folder(target))
    description = _description(config, conversion)
    if is_complete(target, CONVERSION, description, config.resume, "--new_root"):
        logger.info("%s is already complete", target)
        return target
    with flagged("--robot.units, --robot.signs, --robot.offsets"):
        _check_joints(conversion.arm, source, config)
    write_dataset(conversion, executor, target, "convert", description, CONVERSION, config.resume)
    logger.info("wrote %d frames with %s to %s", source.info["total_frames"], _declaration(conversion), target)
    return target


def _check_source(source: SourceDataset) -> None:
    lacking = [key for key in (keys.STATE, keys.ACTION) if key not in source.features]
    if lacking:
        raise DatasetError(f"the dataset lacks {' and '.join(lacking)}")
    source.check_files(list(source.features))


def _plan(config: ConvertActionsConfig, source: SourceDataset, folder: Path) -> Conversion:
    calibration, workspace = calibration_and_workspace(
        config.calibration, config.workspace, source.features, config.camera, config.pose
    )
    height = calibration.origin_height if calibration else 0.0
    states, actions = (names_of(source.features, key) for key in (keys.STATE, keys.ACTION))
    with flagged("--robot"):
        arm = config.robot.make_arm(states, actions, [*workspace.center, -height])
    calibrated = calibration.cameras if calibration else {}
    cameras = {name: camera for name, camera in calibrated.items() if keys.rgb(name) in source.features}
    with flagged("--calibration"):
        if calibrated and not cameras:
            images = [key.removeprefix(keys.IMAGES) for key in source.features if key.startswith(keys.IMAGES)]
            logger.warning(
                "none of the calibration's cameras, %s, is in the dataset, which has %s: its calibration is not added",
                ", ".join(calibrated),
                ", ".join(images) or "none",
            )
        for name, camera in cameras.items():
            _check_camera(name, camera, source, workspace)
    try:
        added = converted_features(source.features, arm, config.actions, workspace, cameras, config.keep)
    except ValueError as error:
        raise ValueError(f"{error}: leave the cameras out of --calibration, or --keep") from None
    return Conversion(
        source=source.folder,
        source_files=source_fingerprint(source),
        folder=folder,
        dropped=[],
        added=added,
        declared=declared_images(source.features, workspace),
        schema=derived_schema(source, [], added),
        arm=arm,
        actions=config.actions,
        horizon=config.horizon,
        cameras=cameras,
        keep=config.keep,
    )


def _check_camera(name: str, camera: Camera, source: SourceDataset, workspace: Workspace) -> None:
    size = image_size(source.features, keys.rgb(name))
    if size != (camera.height, camera.width):
        raise CalibrationError(
            f"camera {name!r} has {camera.height} x {camera.width} pixels, its images in the dataset {size}"
        )
    check_camera(name, camera, workspace)


def _check_joints(arm: Arm, source: SourceDataset, config: ConvertActionsConfig) -> None:
    """Raise a KinematicsError if joints contradict the model; say what is unusual in where the gripper goes."""
    values = all_vectors(source, keys.STATE)
    check_positions(arm, values, config.robot.units)
    frames = arm.model.forward(arm.positions(values[:: len(values) // MOST_CHECKED + 1]))
    poses = tool_poses(frames, arm.model.pivot)
    singular = float(is_singular(frames, arm.model.pivot).mean())
    if singular:
        logger.warning(
            "in %.1f %% of the frames the fingers point up, or the gripper is over the first joint: "
            "yaw and tilt are undefined there",
            100 * singular,
        )
    below = poses[:, 2] < arm.origin[2] - BELOW
    if below.any():
        logger.warning(
            "in %.1f %% of the frames the gripper is more than %.0f mm below the table, %.0f mm at most: check the "
            "base's height, the units and the tool's frame",
            100 * below.mean(),
            1000 * BELOW,
            1000 * (arm.origin[2] - poses[:, 2].min()),
        )
    tilt = np.rad2deg(np.quantile(poses[:, 4], [0.01, 0.99]))
    logger.info("the gripper is tilted by %.0f to %.0f degrees off straight down", *tilt)


def _declaration(conversion: Conversion) -> str:
    names = {key: ", ".join(conversion.added[key]["names"]) for key in (keys.STATE, keys.ACTION)}
    return f"the state {names[keys.STATE]} and the action {names[keys.ACTION]}"


def _description(config: ConvertActionsConfig, conversion: Conversion) -> dict[str, Any]:
    """Return all settings that determine the result."""
    return plain(
        {
            "repo_id": config.target().repo_id,
            "source": config.dataset.repo_id,
            "source_files": conversion.source_files,
            "arm": conversion.arm.plain(),
            "robot": asdict(config.robot),
            "actions": conversion.actions,
            "horizon": conversion.horizon,
            "keep": conversion.keep,
            "features": {key: feature for key, feature in conversion.added.items() if key != keys.STATE},
            "symview": version("lerobot_policy_symview"),
        }
    )


def main() -> None:
    """Run the console command."""
    run_command(ConvertActionsConfig, convert_actions, EXAMPLES, short={"--root": "--dataset.root", **POSE_FLAGS})
