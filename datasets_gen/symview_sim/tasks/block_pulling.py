"""Block pulling: bring two flat blocks together."""

from __future__ import annotations

import numpy as np

from lerobot_symview.geometry.camera import Array
from symview_sim.motions import sweep
from symview_sim.placing import random_places
from symview_sim.scene import Scene
from symview_sim.tasks.base import Task

SIZE = (0.08, 0.08, 0.05)
BEHIND = 0.08  # metres behind the moved block where a sweep starts
HEIGHT = 0.03
TOUCHING = 0.002  # metres
SPARE = 0.005  # metres of space that a sweep can do without
NEAR, GENTLE = 0.06, 0.08  # metres, metres per second: blocks that are closer than NEAR are moved at GENTLE


class BlockPulling(Task):
    """Two blue flat blocks lie in the workspace; solved when they touch."""

    instruction = "Pull the two blue blocks together."
    ways = 2  # which block is moved

    def spawn(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the blocks more than 13.6 cm apart."""
        places = random_places(rng, scene.workspace, paddings=(0.068, 0.068), distance=0.136)
        yaws = rng.uniform(-np.pi / 2, np.pi / 2, size=2)
        self._blocks = [
            scene.add_box(SIZE, 0.5, 0.5, (0.1, 0.2, 0.9), (*place, SIZE[2] / 2), yaw)
            for place, yaw in zip(places, yaws, strict=True)
        ]

    def is_success(self, scene: Scene) -> bool:
        """Whether the gap between the blocks is below 2 mm: blocks may separate slightly after they touch."""
        return scene.gap(self._blocks[0], self._blocks[1], longest=0.01) < TOUCHING

    def is_valid(self, scene: Scene) -> bool:
        """Whether the gripper can reach both blocks."""
        return all(scene.within_reach(block) for block in self._blocks)

    def expert_action(self, scene: Scene) -> Array:
        """Sweep one block towards the other with an open gripper: the block with more free space behind it.

        With equal space, sweep the block nearer to the gripper. The blocks look alike, so the choice must depend on the
        positions of the blocks and the gripper alone.
        """
        options = self._options(scene)
        _, _, start, other = min(options, key=lambda option: option[:2])
        return self._action(scene, start, other, by_hand=False)

    def action_of_way(self, scene: Scene, way: int) -> Array:
        """Sweep one of the blocks, or the other one if only that has free space behind it."""
        options = self._options(scene)
        least = min(lacking for lacking, *_ in options)
        _, _, start, other = options[way] if options[way][0] <= least + SPARE else options[1 - way]
        return self._action(scene, start, other, by_hand=True)

    def _options(self, scene: Scene) -> list[tuple[float, float, Array, Array]]:
        """Return for each block, if it is moved: lacking space, distance from the gripper, start and end of a sweep."""
        places = [scene.pose(block)[0][:2] for block in self._blocks]
        options = []
        for moved, other in (places, places[::-1]):
            along = (other - moved) / np.linalg.norm(other - moved)
            behind = moved - BEHIND * along
            start = scene.clip_to_workspace(behind)
            lacking = round(float(np.linalg.norm(start - behind)), 2)
            options.append((lacking, float(np.linalg.norm(scene.arm.position[:2] - moved)), start, other))
        return options

    def _action(self, scene: Scene, start: Array, end: Array, by_hand: bool) -> Array:
        is_near = scene.gap(self._blocks[0], self._blocks[1], longest=NEAR) < NEAR
        step = scene.control.step_at(GENTLE if is_near else scene.control.speed, by_hand)
        return np.append(sweep(scene.arm.position, scene.arm.yaw, start, end, HEIGHT, step), 1.0)


TASK = BlockPulling
