"""Block in bowl: place a cube in a bowl."""

from __future__ import annotations

import numpy as np

from lerobot_symview.geometry.camera import Array
from symview_sim.control import OPEN
from symview_sim.grasping import LIFT, carry, grasp
from symview_sim.placing import random_places
from symview_sim.scene import Scene
from symview_sim.shapes import bowl_parts
from symview_sim.tasks.base import Task

EDGE = 0.05
UPRIGHT = np.pi / 9
INSIDE = 0.03  # metres between the cube's centre and the bowl's
RELEASE = 0.1  # metres above the table at which the cube is released
TRAVEL = 0.15


class BlockInBowl(Task):
    """A red cube and a yellow bowl; solved when the cube lies in the upright bowl and is released."""

    instruction = "Put the red block into the bowl."
    ways = 2  # pairs of faces
    mistakes = ("wrong_place", "early_close")

    def spawn(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the cube and the bowl more than 17 cm apart."""
        cube, bowl = random_places(rng, scene.workspace, paddings=(0.06, 0.085), distance=0.17)
        yaw = rng.uniform(-np.pi / 2, np.pi / 2)
        self._cube = scene.add_box((EDGE, EDGE, EDGE), 0.1, 1.0, (0.9, 0.1, 0.1), (*cube, EDGE / 2), yaw)
        self._bowl = scene.add_compound(bowl_parts(), 0.1, 1.0, (0.95, 0.8, 0.1), (*bowl, 0.0), 0.0)

    def is_success(self, scene: Scene) -> bool:
        """Whether the released cube lies in the bowl and the bowl is upright."""
        return self._lies_inside(scene) and scene.tilt(self._bowl) < UPRIGHT

    def is_valid(self, scene: Scene) -> bool:
        """Whether the gripper can reach the cube and the bowl."""
        return scene.within_reach(self._cube) and scene.within_reach(self._bowl)

    def expert_action(self, scene: Scene) -> Array:
        """Grasp the cube, carry it above the bowl and release it."""
        return self._action(scene)

    def action_of_way(self, scene: Scene, way: int) -> Array:
        """Do the same by one pair of the cube's faces."""
        return self._action(scene, faces=way)

    def _action(self, scene: Scene, faces: int | None = None) -> Array:
        if self._lies_inside(scene):
            return np.append(LIFT, OPEN)
        if scene.arm.holds(self._cube):
            goal = np.array([*scene.pose(self._bowl)[0][:2], RELEASE])
            return carry(scene, goal, 0.0, TRAVEL)
        return grasp(scene, self._cube, from_above=True, faces=faces)

    def _lies_inside(self, scene: Scene) -> bool:
        offset = scene.pose(self._cube)[0][:2] - scene.pose(self._bowl)[0][:2]
        touches = scene.touch(self._cube, self._bowl) and not scene.arm.holds(self._cube)
        return bool(touches and np.linalg.norm(offset) < INSIDE)


TASK = BlockInBowl
