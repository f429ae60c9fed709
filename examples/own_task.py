"""A task of your own with a scripted expert: put the block onto the mark at the centre of the workspace.

    python examples/own_task.py --episodes=20

The decorator registers the task in this process; an entry point of a package makes it known to the commands and to
worker processes, see docs/own_task.md.
"""

import argparse
import logging

import numpy as np

from symview_sim.demonstration import demonstrate
from symview_sim.grasping import CLEARANCE, carry, grasp
from symview_sim.scene import Scene
from symview_sim.settings import EnvSettings
from symview_sim.tasks import register_task
from symview_sim.tasks.base import Task

EDGE, NEAR = 0.05, 0.02  # metres


@register_task("centring")
class BlockCentring(Task):
    """A green block lies around a blue mark; solved when the block is on the mark and released."""

    instruction = "Put the green block onto the blue mark."

    def spawn(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the block 8 to 14 cm from the centre, in any direction."""
        angle = rng.uniform(-np.pi, np.pi)
        self.goal = np.array([*scene.workspace.center, EDGE / 2])
        place = self.goal + rng.uniform(0.08, 0.14) * np.array([np.cos(angle), np.sin(angle), 0])
        self.block = scene.add_box((EDGE, EDGE, EDGE), 0.1, 1.0, (0.1, 0.6, 0.2), place, yaw=angle)
        scene.add_marking(0.08, (0.1, 0.2, 0.9), self.goal[:2])

    def is_success(self, scene: Scene) -> bool:
        """Whether the block is on the mark and released."""
        offset = scene.pose(self.block)[0] - self.goal
        return bool(np.linalg.norm(offset) < NEAR and not scene.arm.holds(self.block))

    def is_valid(self, scene: Scene) -> bool:
        """Whether the gripper can reach the block."""
        return scene.within_reach(self.block)

    def expert_action(self, scene: Scene) -> np.ndarray:
        """Grasp the block, carry it to the mark and release it; depends on the current state alone."""
        if scene.arm.holds(self.block):
            return carry(scene, self.goal, yaw_change=0.0, travel_height=CLEARANCE)
        return grasp(scene, self.block, from_above=False)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20)
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    attempts = [demonstrate(EnvSettings("centring"), 0, i, noise=0.1).attempts for i in range(args.episodes)]
    logging.getLogger(__name__).info("%d demonstrations in %d attempts", args.episodes, sum(attempts))
