"""The simulated SO-101 follower behind LeRobot's interface of robots."""

from __future__ import annotations

import logging

import numpy as np
from lerobot.lerobot_types import RobotAction, RobotObservation
from lerobot.robots import Robot
from lerobot.utils.errors import DeviceNotConnectedError

from lerobot_policy_symview.config_so101_sim import So101SimConfig
from symview_sim.so101.world import CAMERA, JOINTS, So101World

logger = logging.getLogger(__name__)

NAMES = tuple(f"{joint}.pos" for joint in JOINTS)
HELD = 3  # actions in a row with the cube in the air, until it counts as lifted


class So101Sim(Robot):
    """A follower with its own cube, whose clock advances by 0.1 s with every action.

    Joints are in degrees, the gripper in per cent, as of LeRobot's SO-101 with `use_degrees`. The camera `side` gives
    colour, and depth as RealSense does: uint16, millimetres.
    """

    config_class = So101SimConfig
    name = "so101_sim"

    def __init__(self, config: So101SimConfig):
        super().__init__(config)
        self.cameras: dict[str, object] = {}  # LeRobot starts threads for each
        self._seed = config.seed
        self._world: So101World | None = None
        self._held = 0
        self.is_solved = False

    @property
    def observation_features(self) -> dict[str, type | tuple[int, ...]]:
        """Names of what is observed: joints, and the camera's images by their shapes."""
        height, width = CAMERA.height, CAMERA.width
        features: dict[str, type | tuple[int, ...]] = dict.fromkeys(NAMES, float)
        features |= {"side": (height, width, 3), "side_depth": (height, width, 1)}
        return features

    @property
    def action_features(self) -> dict[str, type]:
        """Names of the joints' targets."""
        return dict.fromkeys(NAMES, float)

    @property
    def is_connected(self) -> bool:
        """Whether the simulation runs."""
        return self._world is not None

    @property
    def is_calibrated(self) -> bool:
        """A simulated arm always is."""
        return True

    @property
    def world(self) -> So101World:
        """The simulation.

        Raises:
            DeviceNotConnectedError: before `connect`.
        """
        if self._world is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        return self._world

    def connect(self, calibrate: bool = True) -> None:
        """Start the simulation in the scene of the configuration."""
        self._world = So101World()
        self.reset(self._seed)

    def reset(self, seed: int) -> None:
        """Put the arm and the cube where `seed` says."""
        self.world.reset(seed)
        self._held, self.is_solved = 0, False

    def get_observation(self) -> RobotObservation:
        """Return the joints, and what the camera sees."""
        images = self.world.images()
        depth = np.round(1000 * images.depth).astype(np.uint16)[..., None]
        joints = dict(zip(NAMES, self.world.joints().tolist(), strict=True))
        return joints | {"side": images.rgb, "side_depth": depth}

    def send_action(self, action: RobotAction) -> RobotAction:
        """Move towards the joints' targets for 0.1 s, and return them."""
        self.world.move(np.array([action[name] for name in NAMES]))
        self._held = self._held + 1 if self.world.is_lifted() else 0
        if self._held == HELD and not self.is_solved:
            self.is_solved = True
            logger.info("the cube is lifted")
        return action

    def disconnect(self) -> None:
        """End the simulation."""
        self.world.close()
        self._world = None

    def calibrate(self) -> None:
        """Do nothing: the joints are those of the model."""

    def configure(self) -> None:
        """Do nothing: there are no motors to set up."""
