"""Random places for objects on the table."""

from __future__ import annotations

import numpy as np

from lerobot_symview.geometry.camera import Array
from lerobot_symview.geometry.workspace import Workspace

TRIES = 10_000


def random_places(
    rng: np.random.Generator, workspace: Workspace, paddings: tuple[float, ...], distance: float = 0.0
) -> list[Array]:
    """Draw one place (2,) per entry of `paddings`, uniformly, at least `distance` metres from each other.

    Args:
        rng: source of randomness.
        workspace: where the places lie, in world coordinates.
        paddings: metres kept free at each side of the workspace, one per place.
        distance: least distance between two places, metres.

    Raises:
        RuntimeError: if so many places do not fit.
    """
    for _ in range(TRIES):
        places = [
            np.asarray(workspace.center) + rng.uniform(-1, 1, size=2) * (workspace.size / 2 - padding)
            for padding in paddings
        ]
        gaps = [np.linalg.norm(a - b) for i, a in enumerate(places) for b in places[:i]]
        if all(gap > distance for gap in gaps):
            return places
    raise RuntimeError(f"{len(paddings)} objects {distance} m apart do not fit into {workspace.size} m")
