"""Bodies built from boxes and cylinders: a bowl, a cabinet and its drawer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Vector = tuple[float, float, float]
WALL = 0.006  # metres
HANDLE_REACH = 0.152  # metres from the cabinet's origin to the centre of the handle bar of the closed drawer
# Metres. The Panda's hand is 20 cm wide and ends 3.5 cm above the point between its fingertips: at this bar it passes
# over the cabinet, and at a lower one it pushes against it.
HANDLE_HEIGHT = 0.088
BOWL_WALLS = 12  # PyBullet crashes at more than 16 parts


@dataclass(frozen=True)
class Part:
    """One convex part of a body, in the body's frame.

    Args:
        size: metres: of a box along x, y, z; of a cylinder about z (diameter, diameter, length).
        position: of the centre, metres.
        euler: fixed-axis angles about x, y, z, rad.
        is_cylinder: whether the part is a cylinder rather than a box.
    """

    size: Vector
    position: Vector
    euler: Vector = (0.0, 0.0, 0.0)
    is_cylinder: bool = False


def bowl_parts(floor_radius: float = 0.045, rim_radius: float = 0.075, height: float = 0.062) -> list[Part]:
    """Return the parts of a bowl: a round floor and twelve slanted walls. Metres; origin at the bottom centre."""
    parts = [Part((2 * floor_radius, 2 * floor_radius, WALL), (0.0, 0.0, WALL / 2), is_cylinder=True)]
    rise, run = height - WALL / 2, rim_radius - floor_radius
    slant = np.arctan2(run, rise)
    length, width = np.hypot(rise, run), 2 * rim_radius * np.tan(np.pi / BOWL_WALLS)
    for i in range(BOWL_WALLS):
        angle = 2 * np.pi * i / BOWL_WALLS
        radius = (floor_radius + rim_radius) / 2
        position = (radius * np.cos(angle), radius * np.sin(angle), (height + WALL / 2) / 2)
        parts.append(Part((WALL, width, length), position, (0.0, slant, angle)))
    return parts


def cabinet_parts(depth: float = 0.213, width: float = 0.228, height: float = 0.108) -> list[Part]:
    """Return the five panels of a cabinet that is open at -x. Metres; origin at the bottom centre."""
    return [
        Part((depth, width, WALL), (0.0, 0.0, WALL / 2)),
        Part((depth, width, WALL), (0.0, 0.0, height - WALL / 2)),
        Part((depth, WALL, height), (0.0, (width - WALL) / 2, height / 2)),
        Part((depth, WALL, height), (0.0, -(width - WALL) / 2, height / 2)),
        Part((WALL, width, height), ((depth - WALL) / 2, 0.0, height / 2)),
    ]


def drawer_parts(side: float = 0.2, height: float = 0.088) -> list[Part]:
    """Return the parts of a drawer, five panels and a handle bar on two posts. Metres; origin as the cabinet's."""
    middle, front = 0.054, -0.105
    center = front + side / 2
    bar = 0.015
    post = -front - HANDLE_REACH + bar / 2  # negative: from the front to the bar, along -x
    return [
        Part((side, side, WALL), (center, 0.0, middle - (height - WALL) / 2)),
        Part((WALL, side, height), (front + WALL / 2, 0.0, middle)),
        Part((WALL, side, height), (front + side - WALL / 2, 0.0, middle)),
        Part((side, WALL, height), (center, (side - WALL) / 2, middle)),
        Part((side, WALL, height), (center, -(side - WALL) / 2, middle)),
        Part((bar, 0.1, bar), (-HANDLE_REACH, 0.0, HANDLE_HEIGHT)),
        Part((-post, 0.01, 0.01), (front + post / 2, 0.045, HANDLE_HEIGHT)),
        Part((-post, 0.01, 0.01), (front + post / 2, -0.045, HANDLE_HEIGHT)),
    ]
