"""Block picking: grasp a cube and lift it."""

from __future__ import annotations

import numpy as np

from lerobot_symview.geometry.camera import Array
from symview_sim.control import CLOSED
from symview_sim.grasping import LIFT, grasp
from symview_sim.placing import random_places
from symview_sim.scene import Scene
from symview_sim.tasks.base import Task

EDGE = 0.05
LIFTED = 0.15  # metres, gripper height


class BlockPicking(Task):
    """A red cube lies anywhere in the workspace; solved when the gripper holds it 15 cm above the table."""

    instruction = "Pick up the red block."
    ways = 2  # pairs of faces
    mistakes = ("wrong_place", "early_close")

    def spawn(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the cube uniformly at random, its yaw within 45 degrees either way."""
        (place,) = random_places(rng, scene.workspace, paddings=(0.06,))
        yaw = rng.uniform(-np.pi / 4, np.pi / 4)
        self._cube = scene.add_box((EDGE, EDGE, EDGE), 0.1, 1.0, (0.9, 0.1, 0.1), (*place, EDGE / 2), yaw)

    def is_success(self, scene: Scene) -> bool:
        """Whether the cube is grasped and lifted."""
        return scene.arm.position[2] > LIFTED and scene.arm.holds(self._cube)

    def is_valid(self, scene: Scene) -> bool:
        """Whether the gripper can reach the cube."""
        return scene.within_reach(self._cube)

    def expert_action(self, scene: Scene) -> Array:
        """Approach the cube in a straight line, or from above in short actions, close on arrival and lift it."""
        return self._action(scene, from_above=False)

    def action_of_way(self, scene: Scene, way: int) -> Array:
        """Do the same from above, by one pair of the cube's faces."""
        return self._action(scene, from_above=True, faces=way)

    def _action(self, scene: Scene, from_above: bool, faces: int | None = None) -> Array:
        if scene.arm.holds(self._cube):
            return np.append(LIFT, CLOSED)
        return grasp(scene, self._cube, from_above, faces)


TASK = BlockPicking
