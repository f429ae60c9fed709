"""A simulated SO-101 follower as a LeRobot robot: `--robot.type=so101_sim`. LeRobot finds its class by this name."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.robots.config import RobotConfig

from lerobot_symview.runtime.flag_errors import FlagError


@RobotConfig.register_subclass("so101_sim")
@dataclass(kw_only=True)
class So101SimConfig(RobotConfig):
    """An SO-101 follower with a cube on the table and a camera `side` with depth, in MuJoCo (extra so101)."""

    seed: int = 0
    """Scene at the start: where the cube lies, and the arm's joints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.seed < 0:
            raise FlagError(f"--robot.seed must not be negative, got {self.seed}")
