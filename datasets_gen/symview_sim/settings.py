"""Settings of an environment and the location of its demonstrations. Importing them starts no simulator."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from lerobot_symview.datasets.hub import HubOptions
from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.placement import CameraSpec, top_camera
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.registry import lookup
from lerobot_symview.runtime.cli import DatasetLocation
from symview_sim.robots import ROBOTS
from symview_sim.tasks import check_task

if TYPE_CHECKING:
    from symview_sim.env import SymviewEnv


# Not frozen, because the plugin's environment configuration derives from this class and from LeRobot's EnvConfig, which
# is not frozen, and Python forbids mixing the two. Do not change an instance: a worker process looks up its environment
# by the hash of the settings.
@dataclass(unsafe_hash=True)
class EnvSettings:
    """A task, a robot arm, the workspace and the cameras of an environment.

    Raises:
        OptionError: if the task or robot is unknown, two cameras have the same name, a camera is named like depth or
            a view of another one, or a number is out of range.
    """

    task: str = "block_picking"
    """The task, such as `block_picking`."""
    robot: str = "panda"
    """The robot arm, `panda` or `kuka`."""
    camera: CameraSpec = field(default_factory=CameraSpec)
    """The first camera: pose, image size and depth sensor."""
    more_cameras: tuple[CameraSpec, ...] = ()
    """Further cameras, such as `[{name: left, azimuth_deg: 90}]`."""
    oracle: bool = False
    """Add the camera `top`, which looks straight down and does not see the arm."""
    depth: bool = True
    """Add each camera's depth image, in metres."""
    segmentation: bool = False
    """Add each camera's segmentation: 0 table, 1 robot, 2 and up the objects."""
    workspace: Workspace = field(default_factory=Workspace)
    """The working area on the table."""
    start_jitter: float = 0.0
    """Largest random displacement of the gripper's start position per axis, metres."""
    max_steps: int = 50
    """Actions per episode."""

    def __post_init__(self) -> None:
        self.check()

    def check(self) -> None:
        """Raise an OptionError unless the settings describe an environment."""
        try:
            check_task(self.task)
            lookup("robot", self.robot, ROBOTS)
        except ValueError as error:
            raise OptionError(str(error)) from None
        if not 0 <= self.start_jitter < math.inf:
            raise OptionError(f"start_jitter must not be negative, got {self.start_jitter}")
        if self.max_steps < 1:
            raise OptionError(f"max_steps must be at least 1, got {self.max_steps}")
        names = [spec.name for spec in self.all_cameras]
        if len(set(names)) < len(names):
            raise OptionError(f"cameras must differ in their names, got {', '.join(names)}")
        for name in names:
            longer = [other for other in names if other.startswith(f"{name}_")]
            if longer:
                raise OptionError(f"camera {longer[0]!r} is named like depth or a view of camera {name!r}: rename it")

    @property
    def all_cameras(self) -> tuple[CameraSpec, ...]:
        """The first camera, the further ones and, with `oracle`, the camera `top`."""
        oracle = (top_camera(self.camera.height, self.workspace),) if self.oracle else ()
        return (self.camera, *self.more_cameras, *oracle)

    def make(self) -> SymviewEnv:
        """Return a new environment. PyBullet is imported only now.

        Raises:
            ModuleNotFoundError: if PyBullet is not installed; the message names the extra.
        """
        try:
            from symview_sim.env import SymviewEnv
        except ModuleNotFoundError as error:
            if error.name != "pybullet":
                raise
            raise ModuleNotFoundError(
                "the simulated tasks need PyBullet: pip install 'lerobot_policy_symview[sim]'", name=error.name
            ) from None
        return SymviewEnv(self)


@dataclass(frozen=True)
class RecordedDataset(DatasetLocation):
    """Location of recorded demonstrations."""

    repo_id: str = "symview/demonstrations"
    """`user/name`, its name on the Hub."""


@dataclass(frozen=True)
class NewDataset(HubOptions, RecordedDataset):
    """Location of new demonstrations, and options of a push to the Hub."""
