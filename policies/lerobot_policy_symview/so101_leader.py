"""A scripted expert in the place of the leader arm, for LeRobot's recording loop."""

from __future__ import annotations

from typing import Any

from lerobot.lerobot_types import RobotAction
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

from lerobot_policy_symview.so101_sim import NAMES, So101Sim
from lerobot_symview.kinematics import arm_chain, read_urdf
from lerobot_symview.kinematics.presets import PRESETS
from symview_sim.so101.expert import So101Expert


class So101Leader(Teleoperator):
    """Lifts the cube of a simulated follower, and ends LeRobot's recording loop once it has.

    Args:
        robot: the follower, connected.
        events: those of the recording loop.
    """

    config_class = TeleoperatorConfig
    name = "so101_leader_sim"

    def __init__(self, robot: So101Sim, events: dict[str, bool]):
        super().__init__(TeleoperatorConfig(id="expert"))
        preset = PRESETS["so101"]
        tree = read_urdf(preset.file())
        arm = arm_chain(tree, preset.tool_frame, gripper=preset.gripper, tool_offset=preset.tool_offset)
        self._robot, self._events = robot, events
        self._expert = So101Expert(robot.world, arm)

    @property
    def action_features(self) -> dict[str, type]:
        """Names of the joints' targets."""
        return self._robot.action_features

    @property
    def feedback_features(self) -> dict[str, type]:
        """It feels nothing."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether the follower is."""
        return self._robot.is_connected

    @property
    def is_calibrated(self) -> bool:
        """It needs no calibration."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Do nothing."""

    def disconnect(self) -> None:
        """Do nothing."""

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing."""

    def get_action(self) -> RobotAction:
        """Return the expert's targets of the joints: degrees, and per cent."""
        self._events["exit_early"] = self._robot.is_solved
        return dict(zip(NAMES, self._expert.action().tolist(), strict=True))
