"""Block pushing: push a cube onto a marked square."""

from __future__ import annotations

import numpy as np

from lerobot_symview.geometry.camera import Array
from symview_sim.motions import sweep
from symview_sim.placing import random_places
from symview_sim.scene import Scene
from symview_sim.tasks.base import Task

EDGE = 0.05
GOAL_EDGE = 0.087
CLOSE = 0.05  # metres between the cube's centre and the square's
BEHIND, SHORT = 0.08, 0.035  # metres: where a push starts behind the cube, and ends before the goal
HEIGHT = 0.03


class BlockPushing(Task):
    """A red cube and a blue square lie in the workspace; solved when their centres are within 5 cm."""

    instruction = "Push the red block onto the blue square."
    ways = 2  # the fingers side by side, or one before the other

    def spawn(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the cube and the square more than 9 cm apart."""
        cube, goal = random_places(rng, scene.workspace, paddings=(0.06, 0.065), distance=0.09)
        yaw = rng.uniform(-np.pi / 2, np.pi / 2)
        self._cube = scene.add_box((EDGE, EDGE, EDGE), 0.1, 1.0, (0.9, 0.1, 0.1), (*cube, EDGE / 2), yaw)
        self._goal = scene.add_marking(GOAL_EDGE, (0.1, 0.2, 0.9), goal)

    def is_success(self, scene: Scene) -> bool:
        """Whether the cube's centre is within 5 cm of the square's."""
        cube, goal = scene.pose(self._cube)[0], scene.pose(self._goal)[0]
        return bool(np.linalg.norm((cube - goal)[:2]) < CLOSE)

    def is_valid(self, scene: Scene) -> bool:
        """Whether the gripper can reach the cube."""
        return scene.within_reach(self._cube)

    def expert_action(self, scene: Scene) -> Array:
        """Sweep with a half-open gripper along the line from the cube to the square."""
        return self._action(scene, turn=0.0, by_hand=False)

    def action_of_way(self, scene: Scene, way: int) -> Array:
        """Push with both fingers, or with the gripper turned by 90 degrees and one of them."""
        return self._action(scene, way * np.pi / 2, by_hand=True)

    def _action(self, scene: Scene, turn: float, by_hand: bool) -> Array:
        cube, goal = scene.pose(self._cube)[0][:2], scene.pose(self._goal)[0][:2]
        along = (goal - cube) / np.linalg.norm(goal - cube)
        start = scene.clip_to_workspace(cube - BEHIND * along)
        step = scene.control.step_at(scene.control.speed, by_hand)
        motion = sweep(scene.arm.position, scene.arm.yaw - turn, start, goal - SHORT * along, HEIGHT, step)
        return np.append(motion, 0.5)


TASK = BlockPushing
