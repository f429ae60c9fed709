"""The processor steps between a robot's joints and the gripper's poses: forward before a policy, inverse after it.

A checkpoint stores the arm as numbers in both steps. The second one starts from the joints that the first one saw last;
LeRobot loads the two apart, so they meet in this module, by the arm.
"""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import PolicyAction, RobotObservation
from lerobot.processor import ObservationProcessorStep, PolicyActionProcessorStep, ProcessorStepRegistry

from lerobot_policy_symview.processor_views import is_training
from lerobot_symview import keys
from lerobot_symview.errors import KinematicsError
from lerobot_symview.kinematics import Arm, arm_from_plain, solve
from lerobot_symview.kinematics.arm import APERTURE, INCREMENT, pose_after
from lerobot_symview.kinematics.inverse import ANGLE_WEIGHT, UNREACHABLE, Unreachable
from lerobot_symview.kinematics.model import Array
from lerobot_symview.kinematics.pose import is_singular, tool_poses
from lerobot_symview.kinematics.units import check_present

logger = logging.getLogger(__name__)

_PRESENT: dict[str, Array] = {}
"""Arm -> the joint positions (B, J) that its robot had last."""


@dataclass
@ProcessorStepRegistry.register(name="symview_joints")
class JointsProcessorStep(ObservationProcessorStep):
    """Reads a robot's joints as the end effector's state, and keeps them for the step that gives joints again.

    An observation with an action is a dataset's, which has the end effector's state; it is kept unchanged.

    Args:
        arm: as `Arm.plain` describes it; without one, nothing is changed.
    """

    arm: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._arm = arm_from_plain(self.arm) if self.arm else None
        self._key = json.dumps(self.arm, sort_keys=True)

    def observation(self, observation: RobotObservation) -> RobotObservation:
        """Return the observation with the end effector's state (B, 6) in place of the joints (B, V).

        Raises:
            KinematicsError: if the state has another number of dimensions, or positions that the arm cannot have.
        """
        if self._arm is None or is_training(self) or keys.STATE not in observation:
            return observation
        state, names = observation[keys.STATE], self._arm.state_names
        if state.ndim != 2 or state.shape[-1] != len(names):
            raise KinematicsError(
                f"{keys.STATE} has shape {tuple(state.shape)}, the robot of the recording gives {len(names)} numbers: "
                f"{', '.join(names)}"
            )
        joints = state.detach().cpu().numpy().astype(np.float64)
        positions = self._arm.positions(joints)
        check_present(self._arm, positions)
        _PRESENT[self._key] = positions
        read = torch.from_numpy(self._arm.states(joints)).to(state.device, torch.float32)
        return observation | {keys.STATE: read}

    def reset(self) -> None:
        """Start an episode: the joints of the last one are forgotten."""
        if self._arm is not None:
            _PRESENT.pop(self._key, None)

    def get_config(self) -> dict[str, Any]:
        """Return the constructor's arguments that a checkpoint stores as JSON."""
        return {"arm": self.arm}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Keep the declared features unchanged: they are the robot's."""
        return features


@dataclass
@ProcessorStepRegistry.register(name="symview_joint_targets")
class JointTargetsProcessorStep(PolicyActionProcessorStep):
    """Turns an end effector's action into targets of the robot's joints, from where they are.

    Args:
        arm: as `Arm.plain` describes it; without one, nothing is changed.
        max_step: degrees that a joint may be sent away from where it is by one action; a longer way is shortened, all
            joints alike. A prismatic joint counts 1 cm as 10 degrees.
        max_error: metres by which the solution may miss; a radian counts as 0.1 m.
        unreachable: what to do beyond: `hold` the joints where they were last sent, or raise an `error`.
    """

    arm: dict[str, Any] = field(default_factory=dict)
    max_step: float = 10.0
    max_error: float = 0.01
    unreachable: Unreachable = "hold"

    def __post_init__(self) -> None:
        if not (0 < self.max_step < np.inf and 0 < self.max_error < np.inf):
            raise ValueError(f"max_step and max_error must be positive, got {self.max_step} and {self.max_error}")
        if self.unreachable not in UNREACHABLE:
            raise ValueError(f"unreachable must be one of {', '.join(UNREACHABLE)}, got {self.unreachable!r}")
        self._arm = arm_from_plain(self.arm) if self.arm else None
        self._key = json.dumps(self.arm, sort_keys=True)
        self._sent: Array | None = None
        self._holds = False

    def action(self, action: PolicyAction) -> PolicyAction:
        """Return the targets (B, W) of the robot's joints and gripper, float32, for actions (B, 6).

        Raises:
            KinematicsError: if no joints were observed, an action has another number of dimensions or is not finite, or
                with `unreachable` `error`, if the arm cannot follow.
        """
        if self._arm is None:
            return action
        wanted = action.detach().cpu().numpy().astype(np.float64)
        present = _PRESENT.get(self._key)
        if present is None or len(present) != len(wanted):
            raise KinematicsError("no joints were observed before this action: run the preprocessor on an observation")
        if wanted.shape[-1] != len(INCREMENT) or not np.isfinite(wanted).all():
            raise KinematicsError(f"an action must be {len(INCREMENT)} finite numbers, got {wanted.tolist()}")
        if self._sent is None or len(self._sent) != len(present):
            self._sent = present.copy()
        for index, (start, increment) in enumerate(zip(present, wanted, strict=True)):
            target = self._solved(self._arm, start, increment)
            self._sent[index] = self._near(self._arm, start, self._sent[index] if target is None else target)
        values = self._arm.actions(self._sent, wanted[:, APERTURE])
        return torch.from_numpy(values).to(action.device, torch.float32)

    def _solved(self, arm: Arm, start: Array, increment: Array) -> Array | None:
        """Return the positions (J,) for an action; None if the arm cannot follow it."""
        frame = arm.model.forward(start[None])
        pose = tool_poses(frame, arm.model.pivot)[0]
        solution = solve(arm.model, start, pose_after(pose, increment))
        is_undefined = bool(is_singular(frame, arm.model.pivot)[0])
        if not is_undefined and max(solution.distance, ANGLE_WEIGHT * solution.angle) <= self.max_error:
            self._holds = False
            return solution.positions
        reason = (
            "yaw or tilt is undefined where the gripper is"
            if is_undefined
            else f"the nearest that the joints reach is {1000 * solution.distance:.0f} mm and "
            f"{np.rad2deg(solution.angle):.0f} degrees away"
        )
        if self.unreachable == "error":
            raise KinematicsError(f"the arm cannot follow the action {increment.round(4).tolist()}: {reason}")
        if not self._holds:
            logger.warning("the arm holds, because it cannot follow the action: %s", reason)
        self._holds = True
        return None

    def _near(self, arm: Arm, start: Array, target: Array) -> Array:
        """Return the target (J,), or the point on the way there that is as far away as allowed."""
        step = target - start
        degrees = np.abs(np.where(arm.model.is_revolute, np.rad2deg(step), 1000 * step)).max()
        shortened: Array = start + step * min(1.0, self.max_step / max(degrees, 1e-12))
        return shortened

    def reset(self) -> None:
        """Start an episode: what was sent last is forgotten."""
        self._sent, self._holds = None, False

    def get_config(self) -> dict[str, Any]:
        """Return the constructor's arguments that a checkpoint stores as JSON."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Keep the declared features unchanged: the robot names its own."""
        return features
