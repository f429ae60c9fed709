"""Drawer opening: hook the handle and pull the drawer out."""

from __future__ import annotations

import numpy as np

from lerobot_symview.geometry.camera import Array
from symview_sim.control import CLOSED
from symview_sim.motions import sweep
from symview_sim.scene import Scene
from symview_sim.shapes import HANDLE_REACH, cabinet_parts, drawer_parts
from symview_sim.tasks.base import Task

OPENED = 0.15  # metres
TRAVEL = 0.2  # metres: the drawer's end stop
BEHIND = 0.027  # metres behind the bar's centre, where the fingers descend: the middle of the gap
PULL, PULL_SPEED = 0.2, 0.16  # metres, and metres per second
HEIGHT = 0.078  # metres: the fingers reach below the bar, and the hand passes over the cabinet
ASIDE = 0.02  # metres from the middle of the bar, where a person hooks it


class DrawerOpening(Task):
    """A cabinet with one drawer stands at a random pose; solved when the drawer is 15 cm open."""

    instruction = "Open the drawer."
    ways = 2  # left and right half of the handle

    def spawn(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the cabinet in a random orientation, with its handle near the workspace's centre."""
        yaw = rng.uniform(0, 2 * np.pi)
        offset = rng.uniform([0.15, -0.10], [0.20, 0.10])
        rotation = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        place = np.asarray(scene.workspace.center) + rotation @ offset
        self._cabinet = scene.add_drawer(cabinet_parts(), drawer_parts(), (*place, 0.0), yaw, TRAVEL)

    def is_success(self, scene: Scene) -> bool:
        """Whether the drawer is open."""
        return scene.opening(self._cabinet) > OPENED

    def is_valid(self, scene: Scene) -> bool:
        """Return True: the cabinet is fixed."""
        return True

    def expert_action(self, scene: Scene) -> Array:
        """Descend behind the middle of the handle with closed fingers, then pull."""
        return self._action(scene, 0.0, scene.control.step_at(PULL_SPEED))

    def action_of_way(self, scene: Scene, way: int) -> Array:
        """Do the same on the left or the right of the handle."""
        return self._action(scene, (ASIDE, -ASIDE)[way], scene.control.step_at(PULL_SPEED, by_hand=True))

    def _action(self, scene: Scene, aside: float, step: float) -> Array:
        cabinet, yaw = scene.pose(self._cabinet)
        inward = np.array([np.cos(yaw), np.sin(yaw)])
        bar = cabinet[:2] - (HANDLE_REACH + scene.opening(self._cabinet)) * inward
        start = bar + BEHIND * inward + aside * np.array([-inward[1], inward[0]])
        motion = sweep(scene.arm.position, scene.arm.yaw, start, start - PULL * inward, HEIGHT, step)
        return np.append(motion, CLOSED)


TASK = DrawerOpening
