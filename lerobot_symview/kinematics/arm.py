"""A robot's numbers read as an arm: joints by name and unit, the gripper's opening, and the place of the workspace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.errors import KinematicsError
from lerobot_symview.kinematics.model import ArmModel, Array, model_from_plain
from lerobot_symview.kinematics.pose import differences, tool_poses

STATE = ("x", "y", "z", "yaw", "aperture", "tilt")
"""Names of an end effector's state: `tilt` is the angle of the fingers off straight down, outwards, radians."""
INCREMENT = ("dx", "dy", "dz", "dyaw", "aperture", "dtilt")
"""Names of an end effector's action: the way from the present pose to the target, and the target of the aperture."""
SUFFIX = ".pos"  # of LeRobot's names of joints
MOVED = [0, 1, 2, 3, 4]  # x, y, z, yaw, tilt of a pose
IN_STATE = [0, 1, 2, 3, 5]  # where a state and an action have them
APERTURE = 4


@dataclass(frozen=True, eq=False)
class Arm:
    """How the numbers that a robot gives and takes set a model's joints and the gripper.

    Args:
        model: the chain of joints.
        joints: the robot's name of each joint of the model, without `.pos`.
        scale: (J,) radians or metres per unit of the robot's numbers.
        offset: (J,) radians or metres at the number 0.
        gripper: the robot's name of the gripper.
        closed: its number at aperture 0.
        opened: its number at aperture 1.
        origin: the workspace's centre on the table in the base's frame, metres: what a state's x, y, z count from.
        state_names: names of the dimensions of a robot's state, in its order.
        action_names: names of those of an action.

    Raises:
        KinematicsError: if a joint is missing, or an action has a dimension that is neither a joint nor the gripper.
    """

    model: ArmModel
    joints: tuple[str, ...]
    scale: Array
    offset: Array
    gripper: str
    closed: float
    opened: float
    origin: Array
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    _columns: dict[str, list[int]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        numbers = [*self.scale, *self.offset, self.closed, self.opened, *self.origin]
        if not (len(self.joints) == len(self.scale) == len(self.offset) == len(self.model.joints)):
            raise KinematicsError(f"expected a name, a scale and an offset for each of {', '.join(self.model.names)}")
        if not np.isfinite(numbers).all() or not np.all(self.scale) or self.closed == self.opened:
            raise KinematicsError(
                "a joint's numbers must be finite, its scale not 0, and those of the closed and open gripper different"
            )
        needed = (*self.joints, self.gripper)
        columns = {}
        for kind, names in (("state", self.state_names), ("action", self.action_names)):
            bare = [bare_name(name) for name in names]
            missing = [name for name in needed if name not in bare]
            if missing:
                raise KinematicsError(f"the {kind} lacks {', '.join(missing)}; it has {', '.join(names)}")
            columns[kind] = [bare.index(name) for name in needed]
        others = [name for name in self.action_names if bare_name(name) not in needed]
        if others:
            raise KinematicsError(f"the action has {', '.join(others)}, which no joint of the arm takes")
        object.__setattr__(self, "_columns", columns)

    def positions(self, states: NDArray[np.floating]) -> Array:
        """Return the model's positions (N, J), radians and metres, of a robot's states (N, V)."""
        return self._positions(states, "state")

    def poses(self, states: NDArray[np.floating]) -> Array:
        """Return the tool's x, y, z in the base's frame, yaw, tilt and lean (N, 6) of a robot's states (N, V)."""
        return tool_poses(self.model.forward(self.positions(states)), self.model.pivot)

    def states(self, states: NDArray[np.floating]) -> Array:
        """Return the end effector's states (N, 6), as `STATE` names them, of a robot's states (N, V)."""
        return self._as_state(self.poses(states), self._aperture(states, "state"))

    def increments(self, states: NDArray[np.floating], actions: NDArray[np.floating]) -> Array:
        """Return the end effector's actions (N, 6), as `INCREMENT` names them: from states (N, V) to actions (N, W)."""
        return self._as_state(
            differences(self.targets(actions), self.poses(states)), self._aperture(actions, "action"), np.zeros(3)
        )

    def targets(self, actions: NDArray[np.floating]) -> Array:
        """Return the tool's pose (N, 6), as `poses` does, at the targets of a robot's actions (N, W)."""
        return tool_poses(self.model.forward(self._positions(actions, "action")), self.model.pivot)

    def end_effectors(self, actions: NDArray[np.floating]) -> Array:
        """Return LeRobot's end effector (N, 7) at the targets of a robot's actions (N, W), as `ee.x`, … name it.

        It is the pose of the tool's frame in the model's file, in the base's frame: metres, a rotation vector in
        radians, and the opening in per cent.
        """
        from scipy.spatial.transform import Rotation

        base_from_tool = self.model.forward(self._positions(actions, "action"))
        base_from_frame = base_from_tool @ np.linalg.inv(self.model.frame_from_tool)
        turned = Rotation.from_matrix(base_from_frame[:, :3, :3]).as_rotvec()
        opening = 100.0 * self._aperture(actions, "action")
        return np.concatenate([base_from_frame[:, :3, 3], turned, opening[:, None]], axis=1)

    def actions(self, positions: NDArray[np.floating], aperture: NDArray[np.floating]) -> Array:
        """Return a robot's actions (N, W) that ask for joint positions (N, J) and apertures (N,) in [0, 1]."""
        values = np.empty((len(positions), len(self.action_names)))
        opening = self.closed + np.clip(aperture, 0.0, 1.0) * (self.opened - self.closed)
        values[:, self._columns["action"][:-1]] = (positions - self.offset) / self.scale
        values[:, self._columns["action"][-1]] = opening
        return values

    def _positions(self, values: NDArray[np.floating], kind: str) -> Array:
        return np.asarray(values, dtype=np.float64)[:, self._columns[kind][:-1]] * self.scale + self.offset

    def _aperture(self, values: NDArray[np.floating], kind: str) -> Array:
        opening = np.asarray(values, dtype=np.float64)[:, self._columns[kind][-1]]
        return np.clip((opening - self.closed) / (self.opened - self.closed), 0.0, 1.0)

    def _as_state(self, poses: Array, aperture: Array, origin: Array | None = None) -> Array:
        found = np.empty((len(poses), len(STATE)))
        found[:, IN_STATE] = poses[:, MOVED]
        found[:, :3] -= self.origin if origin is None else origin
        found[:, APERTURE] = aperture
        return found

    def plain(self) -> dict[str, Any]:
        """Return the arm as JSON types, from which `arm_from_plain` makes it again."""
        return {
            "model": self.model.plain(),
            "joints": list(self.joints),
            "scale": self.scale.tolist(),
            "offset": self.offset.tolist(),
            "gripper": self.gripper,
            "closed": self.closed,
            "opened": self.opened,
            "origin": self.origin.tolist(),
            "state_names": list(self.state_names),
            "action_names": list(self.action_names),
        }


def arm_from_plain(content: Mapping[str, Any]) -> Arm:
    """Return the arm that `Arm.plain` described.

    Raises:
        KinematicsError: if the content is malformed.
    """
    try:
        return Arm(
            model_from_plain(content["model"]),
            tuple(map(str, content["joints"])),
            np.array(content["scale"], dtype=np.float64).reshape(-1),
            np.array(content["offset"], dtype=np.float64).reshape(-1),
            str(content["gripper"]),
            float(content["closed"]),
            float(content["opened"]),
            np.array(content["origin"], dtype=np.float64).reshape(3),
            tuple(map(str, content["state_names"])),
            tuple(map(str, content["action_names"])),
        )
    except KinematicsError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise KinematicsError(f"a stored arm is malformed: {type(error).__name__} {error}") from None


def pose_after(pose: Array, increment: Sequence[float] | NDArray[np.floating]) -> Array:
    """Return the pose (6,) that an end effector's action (6,) asks for at a pose; the lean is kept."""
    target = pose.copy()
    target[MOVED] += np.asarray(increment, dtype=np.float64)[IN_STATE]
    return target


def bare_name(name: str) -> str:
    """Return the name of a joint without LeRobot's `.pos`."""
    return name.removesuffix(SUFFIX)
