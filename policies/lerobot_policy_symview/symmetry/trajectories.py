"""Action chunks as trajectories relative to the gripper's pose at their start, and the scales of these trajectories.

The dimensions `x`, `y`, `z`, `yaw`, `rx` and `ry` of an action move the gripper; the others, such as the aperture, keep
their values. The pose after action k relative to the start is the sum of the first k increments, or the difference
between an absolute target and the state.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor

from lerobot_policy_symview.symmetry.representations import SMALLEST_EXTENT, VectorRepresentation
from lerobot_policy_symview.symmetry.transforms import PlanarTransform

ActionMode = Literal["delta", "absolute"]
MOVING = ("x", "y", "z", "yaw", "rx", "ry")


@dataclass(frozen=True)
class Trajectories:
    """Converts chunks of actions to relative trajectories and back, in the order of the action's dimensions.

    Args:
        actions: how an action's dimensions transform.
        states: how a state's dimensions transform.
        mode: `delta` if an action moves the gripper from where it is, `absolute` if it says where the gripper shall be,
            in the state's coordinates.

    Raises:
        ValueError: if absolute actions have a dimension that moves the gripper and that the state lacks, or a rotation
            vector, whose relative rotation is not a difference.
    """

    actions: VectorRepresentation
    states: VectorRepresentation
    mode: ActionMode = "delta"

    def __post_init__(self) -> None:
        if self.mode == "delta":
            return
        labels = [self.actions.dimensions[i] for i in self.moving]
        missing = [label for label in labels if label not in self.states.dimensions]
        if missing:
            raise ValueError(
                f"--policy.action_mode=absolute needs the gripper's {', '.join(missing)} in {self.states.flag}, got "
                f"{list(self.states.dimensions)}"
            )
        if self.actions.of_type("rx"):
            raise ValueError(
                "--policy.action_mode=absolute does not support rotation vectors (rx, ry): record increments of the "
                "rotation, or declare its dimensions as scalar"
            )

    @cached_property
    def moving(self) -> list[int]:
        """Indices of the action's dimensions that move the gripper."""
        return sorted(index for kind in MOVING for index in self.actions.of_type(kind))

    def relative(self, actions: Tensor, state: Tensor, is_pad: Tensor | None = None) -> Tensor:
        """Return the trajectories (B, H, A) of chunks of actions.

        Args:
            actions: (B, H, A), metres and radians.
            state: (B, N) at the start.
            is_pad: (B, H) bool, the actions after the end of an episode; there, the gripper stays where it is.
        """
        trajectory = actions.clone()
        moving = actions[..., self.moving]
        if self.mode == "absolute":
            trajectory[..., self.moving] = self._nearest(moving - self._start(state)[:, None])
            return trajectory
        if is_pad is not None:
            moving = torch.where(is_pad[..., None], torch.zeros_like(moving), moving)
        trajectory[..., self.moving] = moving.cumsum(dim=1)
        return trajectory

    def actions_of(self, trajectory: Tensor, state: Tensor) -> Tensor:
        """Return the chunks of actions (B, H, A) of trajectories (B, H, A) that start at states (B, N)."""
        actions = trajectory.clone()
        moving = trajectory[..., self.moving]
        if self.mode == "absolute":
            actions[..., self.moving] = moving + self._start(state)[:, None]
        else:
            actions[..., self.moving] = torch.diff(moving, dim=1, prepend=torch.zeros_like(moving[:, :1]))
        return actions

    def transform(self, actions: Tensor, transform: PlanarTransform) -> Tensor:
        """Return actions (B, A) for transformed scenes."""
        return self.actions.transform(actions, transform, absolute_yaw=self.mode == "absolute")

    def scale(self, action: Mapping[str, Any], state: Mapping[str, Any] | None, horizon: int) -> tuple[Tensor, Tensor]:
        """Return centre and half-width of the trajectories, by which scaling is equivariant.

        A single increment is scaled by its range. In a longer chunk, the displacement after k increments is scaled by
        k times their root mean square, the size that it has if the gripper goes on as it started. That of a target is
        at most its distance from any state. A dimension without extent gets width 1.

        Args:
            action: `min` and `max` (A,) of the actions in the dataset; for chunks of increments also `mean` and `std`.
            state: `min` and `max` (N,) of the states, where they are known.
            horizon: H.

        Returns:
            (A,) each if H is 1, else (H, A) each.

        Raises:
            ValueError: if chunks of increments lack a statistic.
        """
        low, high = (torch.as_tensor(action[end], dtype=torch.float32) for end in ("min", "max"))
        center, width = self.actions.scale(low, high)
        if horizon == 1 and self.mode == "delta":
            return center, width
        if self.mode == "absolute":
            first, last = self._state_range(state, low, high)
            reach = self._shared(torch.maximum((high - first).abs(), (last - low).abs()))
            yaws = self.actions.of_type("yaw")
            reach[yaws] = reach[yaws].clamp(max=math.pi)
            moving = reach.expand(horizon, -1)
        else:
            if lacking := {"mean", "std"} - set(action):
                raise ValueError(f"chunks of actions need their {' and '.join(sorted(lacking))}, got {sorted(action)}")
            mean, deviation = (torch.as_tensor(action[name], dtype=torch.float32) for name in ("mean", "std"))
            moving = torch.arange(1, horizon + 1)[:, None] * self._shared(torch.hypot(mean, deviation))
        moving = torch.where(moving > SMALLEST_EXTENT, moving, 1.0)
        center, width = center.repeat(horizon, 1), width.repeat(horizon, 1)
        center[:, self.moving], width[:, self.moving] = 0.0, moving[:, self.moving]
        return (center[0], width[0]) if horizon == 1 else (center, width)

    def _state_range(self, state: Mapping[str, Any] | None, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
        """Return the ends (A,) of the state's range in the moving dimensions; where it is unknown, those given."""
        first, last = low.clone(), high.clone()
        for index in self.moving:
            label = self.actions.dimensions[index]
            if state is not None and label in self.states.dimensions:
                column = self.states.dimensions.index(label)
                first[index], last[index] = (float(state[end][column]) for end in ("min", "max"))
        return first, last

    def _shared(self, extents: Tensor) -> Tensor:
        """Return extents (A,) of which the two dimensions of a vector have the larger one."""
        shared = extents.clone()
        for pair in self.actions.pairs:
            shared[list(pair)] = extents[list(pair)].max()
        return shared

    def _start(self, state: Tensor) -> Tensor:
        """Return the gripper's pose in the moving dimensions."""
        return state[:, [self.states.dimensions.index(self.actions.dimensions[i]) for i in self.moving]]

    def _nearest(self, displacement: Tensor) -> Tensor:
        """Return displacements (..., M) with yaw differences in [-pi, pi)."""
        nearest = displacement.clone()
        for place, index in enumerate(self.moving):
            if self.actions.dimensions[index].split(":")[0] == "yaw":
                nearest[..., place] = (displacement[..., place] + math.pi) % (2 * math.pi) - math.pi
        return nearest
