"""Random positions of objects on the table."""

from __future__ import annotations

import numpy as np

from lerobot_symview.geometry.camera import Array
from lerobot_symview.geometry.workspace import Workspace

TRIES = 10_000


def random_places(
    rng: np.random.Generator, workspace: Workspace, paddings: tuple[float, ...], distance: float = 0.0
) -> list[Array]:
    """Draw one position (2,) per entry of `paddings`, uniformly, world frame, metres.

    Args:
        rng: source of randomness.
        workspace: the square that contains all positions.
        paddings: distance of each position from the workspace's border, metres.
        distance: smallest distance between two positions, metres.

    Raises:
        RuntimeError: if 10,000 draws contain no valid one.
    """
    for _ in range(TRIES):
        places = [
            np.asarray(workspace.center) + rng.uniform(-1, 1, size=2) * (workspace.size / 2 - padding)
            for padding in paddings
        ]
        gaps = [np.linalg.norm(a - b) for i, a in enumerate(places) for b in places[:i]]
        if all(gap > distance for gap in gaps):
            return places
    raise RuntimeError(f"{len(paddings)} objects {distance} m apart do not fit into a workspace of {workspace.size} m")
