"""Block stacking: put one cube on another."""

from __future__ import annotations

import numpy as np

from lerobot_symview.geometry.camera import Array
from symview_sim.control import OPEN
from symview_sim.grasping import LIFT, carry, grasp
from symview_sim.motions import yaw_difference
from symview_sim.placing import random_places
from symview_sim.scene import Scene
from symview_sim.tasks.base import Task

EDGE = 0.05
OFFSET = 0.025  # metres, largest horizontal offset between the centres of stacked cubes per axis
STABLE_STEPS = 100
RELEASE = 1.15 * EDGE  # metres above the lower cube's centre at which the upper one is released
TRAVEL = 0.16  # metres above the table at which a cube is carried


class BlockStacking(Task):
    """Two red cubes lie in the workspace; solved when one rests on the other, released and stable."""

    instruction = "Stack the red blocks."
    ways = 4  # either cube first, by either pair of its faces
    mistakes = ("wrong_place", "early_close")

    def spawn(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the cubes more than 12 cm apart."""
        places = random_places(rng, scene.workspace, paddings=(0.06, 0.06), distance=0.12)
        self._cubes = [
            scene.add_box(
                (EDGE, EDGE, EDGE), 0.1, 1.0, (0.9, 0.1, 0.1), (*place, EDGE / 2), rng.uniform(-np.pi / 4, np.pi / 4)
            )
            for place in places
        ]

    def is_success(self, scene: Scene) -> bool:
        """Whether a stack stands, no cube is grasped, and the stack still stands 100 simulation steps later."""
        if not self._stands(scene) or any(scene.arm.holds(cube) for cube in self._cubes):
            return False
        scene.wait(STABLE_STEPS)
        return self._stands(scene)

    def is_valid(self, scene: Scene) -> bool:
        """Whether the gripper can reach both cubes."""
        return all(scene.within_reach(cube) for cube in self._cubes)

    def expert_action(self, scene: Scene) -> Array:
        """Grasp the nearer cube, carry it above the other, release it and rise."""
        distances = [np.linalg.norm(scene.arm.position[:2] - scene.pose(cube)[0][:2]) for cube in self._cubes]
        return self._action(scene, self._cubes[int(np.argmin(distances))])

    def action_of_way(self, scene: Scene, way: int) -> Array:
        """Do the same with one of the cubes, by one pair of its faces."""
        return self._action(scene, self._cubes[way // 2], faces=way % 2)

    def _action(self, scene: Scene, first: int, faces: int | None = None) -> Array:
        if self._stands(scene):
            return np.append(LIFT, OPEN)
        held = [cube for cube in self._cubes if scene.arm.holds(cube)]
        if held:
            (other,) = set(self._cubes) - {held[0]}
            base, yaw = scene.pose(other)
            goal = base + [0, 0, RELEASE]
            return carry(scene, goal, yaw_difference(scene.arm.yaw, yaw, period=np.pi / 2), TRAVEL)
        return grasp(scene, first, from_above=True, faces=faces)

    def _stands(self, scene: Scene) -> bool:
        lower, upper = sorted((scene.pose(cube)[0] for cube in self._cubes), key=lambda position: position[2])
        aligned = (np.abs(upper[:2] - lower[:2]) < OFFSET).all()
        return bool(aligned and upper[2] - lower[2] > 0.9 * EDGE and scene.touch(*self._cubes))


TASK = BlockStacking
