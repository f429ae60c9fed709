"""What an environment is made from, and where its demonstrations are: plain settings that start no simulator."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from lerobot_symview.datasets.hub import HubOptions
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.registry import lookup
from lerobot_symview.runtime.cli import DatasetLocation
from symview_sim.robots import ROBOTS
from symview_sim.tasks import check_task

if TYPE_CHECKING:
    from symview_sim.env import SymviewEnv


@dataclass(frozen=True)
class EnvSettings:
    """A task, an arm and what is seen of them."""

    task: str = "block_picking"
    """Which task."""
    robot: str = "panda"
    """Which arm, `panda` or `kuka`."""
    camera: CameraSpec = field(default_factory=CameraSpec)
    """Where the camera stands."""
    more_cameras: tuple[CameraSpec, ...] = ()
    """Further cameras, such as `[{name: left, azimuth_deg: 90}]`."""
    oracle: bool = False
    """Add the camera `top`, which looks straight down and does not see the arm."""
    depth: bool = True
    """Record depth."""
    segmentation: bool = False
    """Record which pixel shows table, robot or which object."""
    start_jitter: float = 0.0
    """Largest random displacement of the gripper's start position per axis, metres."""
    max_steps: int = 50
    """Actions per episode."""

    def __post_init__(self) -> None:
        check_task(self.task)
        lookup("robot", self.robot, ROBOTS)
        if self.start_jitter < 0:
            raise ValueError(f"--env.start_jitter must not be negative, got {self.start_jitter}")
        if self.max_steps < 1:
            raise ValueError(f"--env.max_steps must be at least 1, got {self.max_steps}")

    def make(self) -> SymviewEnv:
        """Return the environment; this imports PyBullet."""
        from symview_sim.env import SymviewEnv

        return SymviewEnv(
            self.task,
            robot=self.robot,
            cameras=(self.camera, *self.more_cameras),
            oracle=self.oracle,
            depth=self.depth,
            segmentation=self.segmentation,
            start_jitter=self.start_jitter,
            max_steps=self.max_steps,
        )


@dataclass(frozen=True)
class RecordedDataset(DatasetLocation):
    """Where demonstrations are."""

    repo_id: str = "symview/demonstrations"
    """`user/name`, its name on the Hub."""


@dataclass(frozen=True)
class NewDataset(HubOptions, RecordedDataset):
    """Where demonstrations go."""
