"""Flags that say which arm a dataset was recorded with, and what its numbers mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lerobot_symview.errors import KinematicsError
from lerobot_symview.kinematics import Arm, FrameTree, arm_chain, joint_scales, read_mjcf, read_urdf
from lerobot_symview.kinematics.arm import bare_name
from lerobot_symview.kinematics.chain import AXES
from lerobot_symview.kinematics.presets import PRESETS
from lerobot_symview.kinematics.units import JointUnits
from lerobot_symview.registry import check_name

FARTHEST = 0.3  # metres of the middle between the fingers from the tool's frame


@dataclass(frozen=True)
class RobotFlags:
    """An arm's model, its names and its units."""

    preset: str | None = None
    """An arm whose model a package ships: so101 (extra so101) or panda (extra sim)."""
    urdf: Path | None = None
    """The arm's URDF; its meshes are not needed. Its root is the robot's base."""
    mjcf: Path | None = None
    """The arm's MJCF, in place of a URDF, with its meshes; MuJoCo reads it (extra so101, metaworld or fetch)."""
    tool_frame: str | None = None
    """Link, or an MJCF's body or site, between the finger tips, such as gripper_frame_link; by default the preset's."""
    tool_offset: float | None = None
    """Metres from that frame, in the direction in which the gripper opens, to the middle between the fingers; by
    default the preset's, 0.04 for so101, whose frame is on the finger that does not move, else 0."""
    approach: str = "z"
    """Axis of that frame in which the fingers point: x, y, z, -x, -y or -z."""
    opening: str | None = None
    """Axis of that frame along which the fingers open; by default as the gripper's joint in the model moves them."""
    joints: dict[str, str] = field(default_factory=dict)
    """The dataset's name -> the model's, of joints whose names differ, the gripper's included: `{elbow: elbow_flex}`. A
    dataset's names are taken without `.pos`."""
    gripper: str = "gripper"
    """The dataset's name of the gripper."""
    gripper_range: tuple[float, float] = (0.0, 100.0)
    """The gripper's numbers when it is closed and when it is open; LeRobot's by default."""
    units: JointUnits = "degrees"
    """Of the joints: degrees; radians; or normalized, LeRobot's -100 to 100, which needs `motors`."""
    motors: Path | None = None
    """LeRobot's calibration file of the arm, calibration/robots/<type>/<id>.json, for normalized joints."""
    signs: dict[str, float] = field(default_factory=dict)
    """Joint -> -1, for joints that turn the other way than in the model."""
    offsets: dict[str, float] = field(default_factory=dict)
    """Joint -> degrees that the model has where the dataset has 0."""

    def __post_init__(self) -> None:
        given = [name for name in ("preset", "urdf", "mjcf") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"--robot.{' and --robot.'.join(given)} exclude each other: give one")
        if self.preset is not None and self.preset not in PRESETS:
            raise ValueError(
                f"--robot.preset must be one of {', '.join(PRESETS)}, whose models packages ship, got {self.preset!r}: "
                "for another arm give its --robot.urdf and --robot.tool_frame"
            )
        for name, axis in (("approach", self.approach), ("opening", self.opening)):
            if axis is not None:
                check_name(f"--robot.{name}", axis, AXES)
        if self.tool_offset is not None and not abs(self.tool_offset) < FARTHEST:
            raise ValueError(f"--robot.tool_offset must be metres, below {FARTHEST}, got {self.tool_offset:g}")
        closed, opened = self.gripper_range
        if not np.isfinite([closed, opened]).all() or closed == opened:
            raise ValueError(f"--robot.gripper_range must be two different numbers, got {closed} and {opened}")

    def make_arm(self, states: Sequence[str], actions: Sequence[str], origin: Sequence[float]) -> Arm:
        """Return the arm.

        Args:
            states: names of the state's dimensions.
            actions: names of those of the action.
            origin: the workspace's centre on the table in the base's frame, metres.

        Raises:
            KinematicsError: if the model cannot be read, or its joints are not the dataset's.
        """
        tree = self._tree()
        preset = PRESETS[self.preset] if self.preset else None
        tool_frame = self.tool_frame or (preset.tool_frame if preset else None)
        if tool_frame is None:
            raise KinematicsError("tool_frame is missing: name the model's frame between the finger tips")
        for kind, names in (("state", states), ("action", actions)):
            if not names:
                raise KinematicsError(f"the {kind}'s dimensions have no names, by which joints are matched")
        gripper = self.joints.get(self.gripper, preset.gripper if preset else self.gripper)
        offset_of_tool = self.tool_offset if self.tool_offset is not None else preset.tool_offset if preset else 0.0
        model = arm_chain(tree, tool_frame, self.approach, self.opening, gripper, offset_of_tool)
        robots_name = self._matched(model.names, [bare_name(name) for name in states], tree)
        joints = tuple(robots_name[name] for name in model.names)
        scale, offset = joint_scales(model, joints, self.units, self.motors, self.signs, self.offsets)
        closed, opened = self.gripper_range
        return Arm(
            model,
            joints,
            scale,
            offset,
            self.gripper,
            float(closed),
            float(opened),
            np.array(origin, dtype=np.float64),
            tuple(states),
            tuple(actions),
        )

    def _tree(self) -> FrameTree:
        if self.mjcf is not None:
            return read_mjcf(self.mjcf.expanduser())
        if self.urdf is not None:
            return read_urdf(self.urdf.expanduser())
        if self.preset is not None:
            return read_urdf(PRESETS[self.preset].file())
        raise KinematicsError("the arm's model is missing: give its urdf or mjcf, or a preset")

    def _matched(self, model_names: Sequence[str], states: Sequence[str], tree: FrameTree) -> dict[str, str]:
        """Return the dataset's names by the model's, of the joints between base and tool."""
        matched: dict[str, str] = {}
        for name, target in self.joints.items():
            try:
                check_name("joint of the dataset", name, states)
                check_name("joint of the model", target, tree.joints)
            except ValueError as error:
                raise KinematicsError(f"joints: {error}") from None
        for name in states:
            target = self.joints.get(name, name)
            if target in matched:
                raise KinematicsError(f"{matched[target]} and {name} are both {target!r} of the model")
            if target in model_names and name != self.gripper:
                matched[target] = name
        missing = [name for name in model_names if name not in matched]
        if missing:
            others = [name for name in states if name not in matched.values() and name != self.gripper]
            raise KinematicsError(
                f"the state lacks {', '.join(missing)}, which the model has between base and tool; its other "
                f"dimensions are {', '.join(others) or 'none'}: match the names by joints, "
                f"'{{{others[0] if others else 'name'}: {missing[0]}}}'"
            )
        return matched
