"""Block picking: grasp a cube and lift it."""

from __future__ import annotations

import numpy as np

from lerobot_symview.camera import Array
from symview_sim.motions import MAX_STEP, is_there, nearest_turn, step_towards
from symview_sim.scene import Scene
from symview_sim.tasks.base import Task

EDGE = 0.05
SPAWN = 0.14  # metres from the workspace centre, each axis, in a workspace of 0.4 m
LIFTED = 0.15  # metres, gripper height


class BlockPicking(Task):
    """A red cube lies anywhere in the workspace; solved when the gripper holds it 15 cm above the table."""

    instruction = "Pick up the red block."

    def spawn(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put the cube down, uniformly in position and within a quarter turn of yaw."""
        reach = SPAWN * scene.workspace.size / 0.4
        xy = np.asarray(scene.workspace.center) + rng.uniform(-reach, reach, size=2)
        yaw = rng.uniform(-np.pi / 4, np.pi / 4)
        self._cube = scene.add_box(np.full(3, EDGE), 0.1, 1.0, (0.9, 0.1, 0.1), np.append(xy, EDGE / 2), yaw)

    def is_success(self, scene: Scene) -> bool:
        """Whether the cube is held and lifted."""
        return scene.arm.position[2] > LIFTED and scene.arm.holds(self._cube)

    def is_valid(self, scene: Scene) -> bool:
        """Whether the cube is where the gripper can reach it."""
        offset = np.abs(scene.pose(self._cube)[0][:2] - scene.workspace.center)
        return bool((offset < scene.workspace.size / 2).all())

    def expert_action(self, scene: Scene) -> Array:
        """Go straight to the cube, close when there, lift once it is held."""
        position, yaw = scene.pose(self._cube)
        if scene.arm.holds(self._cube):
            return np.array([0.0, 0.0, MAX_STEP, 0.0, 0.0])
        turn = nearest_turn(scene.arm.yaw, yaw, period=np.pi / 2)
        aperture = 0.0 if is_there(scene.arm.position, position, turn) else 1.0
        return np.append(step_towards(scene.arm.position, position, turn), aperture)


TASK = BlockPicking
