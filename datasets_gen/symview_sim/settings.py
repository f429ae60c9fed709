"""Settings of an environment and the location of its demonstrations. Importing them starts no simulator."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

from lerobot_symview import keys
from lerobot_symview.datasets.hub import HubOptions
from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.placement import CameraSpec, top_camera
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.registry import check_name, lookup
from lerobot_symview.runtime.cli import DatasetLocation
from symview_sim.control import CONTROLS
from symview_sim.robots import ROBOTS
from symview_sim.tasks import TASK_NAMES, check_task

if TYPE_CHECKING:
    from symview_sim.env import SymviewEnv
    from symview_sim.table_env import TableEnv

STYLES = ("planner", "human")
WRIST_SIZE = 96  # rows and columns of the camera on the gripper, pixels


# Not frozen, because the plugin's environment configurations derive from these classes and from LeRobot's EnvConfig,
# which is not frozen, and Python forbids mixing the two. Do not change an instance: a worker process looks up its
# environment by the hash of the settings.
@dataclass(unsafe_hash=True)
class WorldSettings(ABC):
    """A task of a simulator, the workspace and the cameras: what the environments of every simulator have in common.

    Raises:
        OptionError: if two cameras have the same name, a camera is named like depth or a view of another one, or a
            number is out of range.
    """

    task: str = ""
    """The task."""
    camera: CameraSpec = field(default_factory=CameraSpec)
    """The first camera: pose, image size and depth sensor."""
    more_cameras: tuple[CameraSpec, ...] = ()
    """Further cameras, such as `[{name: left, azimuth_deg: 90}]`."""
    depth: bool = True
    """Add each camera's depth image, in metres."""
    workspace: Workspace = field(default_factory=Workspace)
    """The working area on the table."""
    max_steps: int | None = None
    """Actions per episode; without a number, the simulator's own."""

    state_names: ClassVar[Sequence[str]] = keys.STATE_NAMES
    action_names: ClassVar[Sequence[str]] = keys.ACTION_NAMES
    packages: ClassVar[tuple[str, ...]] = ()
    """Distributions whose versions determine what is recorded."""

    def __post_init__(self) -> None:
        self.check()

    def check(self) -> None:
        """Raise an OptionError unless the settings describe an environment."""
        if self.max_steps is not None and self.max_steps < 1:
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
        """The first camera and the further ones."""
        return (self.camera, *self.more_cameras)

    @classmethod
    @abstractmethod
    def task_names(cls) -> Sequence[str]:
        """Return the names of the simulator's tasks."""

    @property
    def has_labels(self) -> bool:
        """Whether each camera has segmentation labels."""
        return False

    @property
    def has_wrist_camera(self) -> bool:
        """Whether observations have the image of a camera on the gripper."""
        return False

    @property
    @abstractmethod
    def actions_per_second(self) -> int:
        """Actions per second of the simulated robot."""

    @property
    @abstractmethod
    def episode_steps(self) -> int:
        """Largest number of actions of an episode."""

    @abstractmethod
    def make(self) -> TableEnv:
        """Return a new environment. The simulator is imported only now.

        Raises:
            ModuleNotFoundError: if the simulator is not installed; the message names the extra.
        """


@contextmanager
def needs_extra(module: str, extra: str, subject: str) -> Iterator[None]:
    """Name the extra to install where an import of `module` fails."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != module:
            raise
        raise ModuleNotFoundError(
            f"{subject} need {module}: pip install 'lerobot_policy_symview[{extra}]'", name=module
        ) from None


@dataclass(unsafe_hash=True)
class EnvSettings(WorldSettings):
    """A task, a robot arm, the workspace and the cameras of a PyBullet environment.

    Raises:
        OptionError: as `WorldSettings`, or if the task, robot, control or style is unknown.
    """

    task: str = "block_picking"
    """The task, such as `block_picking`."""
    robot: str = "panda"
    """The robot arm, `panda` or `kuka`."""
    oracle: bool = False
    """Add the camera `top`, which looks straight down and does not see the arm."""
    wrist_camera: bool = False
    """Add the colour image of the camera `wrist`, which is fixed to the gripper and looks at its fingertips."""
    segmentation: bool = False
    """Add each camera's segmentation: 0 table, 1 robot, 2 and up the objects."""
    control: str = "coarse"
    """`coarse`: 4 actions a second, each at most 5 cm and 45 degrees, 50 an episode; `fine`: 10 a second, 1.5 cm and 15
    degrees, 200 an episode."""
    style: str = "planner"
    """`planner`: the expert moves straight and the state determines its action; `human`: in every episode it has
    another pace and path, pauses, chooses one of the task's ways, corrects itself, and now and then makes a mistake."""
    start_jitter: float = 0.0
    """Largest random displacement of the gripper's start position per axis, metres."""

    packages: ClassVar[tuple[str, ...]] = ("pybullet",)

    def check(self) -> None:
        """Raise an OptionError unless the settings describe an environment."""
        try:
            check_task(self.task)
            lookup("robot", self.robot, ROBOTS)
            lookup("control", self.control, CONTROLS)
            check_name("style", self.style, STYLES)
        except ValueError as error:
            raise OptionError(str(error)) from None
        if not 0 <= self.start_jitter < math.inf:
            raise OptionError(f"start_jitter must not be negative, got {self.start_jitter}")
        if self.wrist_camera and keys.WRIST in [spec.name for spec in self.all_cameras]:
            raise OptionError(f"wrist_camera adds the camera {keys.WRIST!r}, which another camera is called: rename it")
        super().check()

    @classmethod
    def task_names(cls) -> Sequence[str]:
        """Return the names of the built-in tasks."""
        return TASK_NAMES

    @property
    def all_cameras(self) -> tuple[CameraSpec, ...]:
        """The first camera, the further ones and, with `oracle`, the camera `top`."""
        oracle = (top_camera(self.camera.height, self.workspace),) if self.oracle else ()
        return (*super().all_cameras, *oracle)

    @property
    def has_labels(self) -> bool:
        """Whether each camera has segmentation labels."""
        return self.segmentation

    @property
    def has_wrist_camera(self) -> bool:
        """Whether observations have the image of a camera on the gripper."""
        return self.wrist_camera

    @property
    def actions_per_second(self) -> int:
        """Actions per second: the simulated robot's speed."""
        return CONTROLS[self.control].actions_per_second

    @property
    def episode_steps(self) -> int:
        """Largest number of actions of an episode."""
        return self.max_steps or CONTROLS[self.control].max_steps

    def make(self) -> SymviewEnv:
        """Return a new environment. PyBullet is imported only now."""
        with needs_extra("pybullet", "sim", "the simulated tasks"):
            from symview_sim.env import SymviewEnv
        return SymviewEnv(self)


@dataclass(frozen=True)
class RecordedDataset(DatasetLocation):
    """Location of recorded demonstrations."""

    repo_id: str = "symview/demonstrations"
    """`user/name`, its name on the Hub."""


@dataclass(frozen=True)
class NewDataset(HubOptions, RecordedDataset):
    """Location of new demonstrations, and options of a push to the Hub."""
