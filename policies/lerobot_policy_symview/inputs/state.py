"""The vector that an encoder gets beside its image: the gripper's pose, other dimensions of the state, the camera."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.symmetry.groups import PlanarGroup, block_diagonal
from lerobot_symview import keys
from lerobot_symview.geometry.workspace import Workspace


class StateInput:
    """Selects, scales and represents the state's dimensions that enter the network.

    Args:
        config: selects them; dimensions that are no part of the gripper's pose always enter.
        workspace: the scale of positions.
    """

    def __init__(self, config: SymviewConfig, workspace: Workspace):
        dimensions = config.state_symmetry
        gripper = {"image": ("z", "aperture"), "vector": keys.STATE_NAMES, "none": ("aperture",)}[config.gripper_input]
        entering = [i for i, label in enumerate(dimensions) if label in gripper or label not in keys.STATE_NAMES]
        self.states = config.states
        self.yaws = [i for i in entering if dimensions[i].split(":")[0] == "yaw"]
        self.indices = [i for i in entering if i not in self.yaws]
        half = workspace.size / 2
        units = {"x": half, "y": half, "z": workspace.height_limit, "aperture": 1.0}
        self.units = [units.get(label) for label in dimensions]
        self.camera_direction = config.camera_direction

    def representation(self, group: PlanarGroup) -> NDArray[np.float64]:
        """Return the matrices (G, D, D) by which the vector transforms."""
        blocks = [self.states.select(self.indices).matrices(group)] if self.indices else []
        blocks += [group.rotation(frequency=2)] * len(self.yaws)
        if self.camera_direction:
            blocks.append(group.rotation())
        return block_diagonal(blocks) if blocks else np.zeros((group.size, 0, 0))

    def scale(self, center: Tensor, width: Tensor) -> tuple[Tensor, Tensor]:
        """Replace centre and half-width (N,) of the gripper's dimensions by those of the workspace."""
        for i, unit in enumerate(self.units):
            if unit is not None:
                center[i], width[i] = 0.0, unit
        return center, width

    def __call__(self, state: Tensor, center: Tensor, width: Tensor, direction: Tensor | None) -> Tensor:
        """Return vectors (B, D).

        A parallel gripper looks the same after half a rotation, so every yaw enters as (cos, sin) of twice the angle.

        Args:
            state: (B, N) states in metres and radians.
            center: (N,) of their range.
            width: (N,) half-width of their range.
            direction: (B, 2) from the workspace centre to the camera, where the configuration wants it.
        """
        parts = [((state - center) / width)[:, self.indices]]
        for yaw in self.yaws:
            twice = 2 * state[:, yaw]
            parts.append(torch.stack([torch.cos(twice), torch.sin(twice)], dim=-1))
        if self.camera_direction:
            assert direction is not None
            parts.append(direction)
        return torch.cat(parts, dim=-1)


def camera_directions(world_from_cam: Tensor, workspace: Workspace) -> Tensor:
    """Return horizontal unit vectors (B, 2) from the workspace centre to cameras with poses (B, 16)."""
    x, y = world_from_cam.view(-1, 4, 4)[:, :2, 3].unbind(-1)
    offset = torch.stack([x - workspace.center[0], y - workspace.center[1]], dim=-1)
    return offset / offset.norm(dim=-1, keepdim=True).clamp(min=1e-6)
