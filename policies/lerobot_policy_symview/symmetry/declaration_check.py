"""How far demonstrations contradict the declared types of their states and actions.

An action moves the state. If the types are right, a demonstration that is rotated or reflected by them is one that the
robot could have made, so the map from actions to the state's motion commutes with every planar transform. The map is
estimated twice, freely and among those that commute; what only the free one explains, in episodes that neither was
estimated from, contradicts the types.

Nothing here sees the scene: types that are wrong alike in states and actions stay consistent and are not found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lerobot_policy_symview.symmetry.groups import PlanarGroup
from lerobot_policy_symview.symmetry.representations import VectorRepresentation
from lerobot_policy_symview.symmetry.trajectories import MOVING, ActionMode

Array = NDArray[np.float64]

LEAST_EPISODES = 3
RESAMPLES = 200
INTERVAL = (2.5, 50.0, 97.5)  # per cent of the resamples
LEAST_EXPLAINED = 0.1  # fraction of a dimension's motion below which nothing is said about it
CONTRADICTED = 0.05  # fraction of the explained motion; a frame that is turned by 13 degrees has it
SINGULAR = 1e-9  # smallest eigenvalue that is used, relative to the largest: dimensions may always move alike
STILL = 1e-9  # root mean square of a dimension that does not move


@dataclass(frozen=True, eq=False)
class Motion:
    """Actions and the motion of the state after them.

    Args:
        states: types of the state.
        actions: types of the action.
        inputs: per episode (N, 1 + A): 1, and the action as a displacement, averaged over a window of frames.
        outputs: per episode (N, S): the state's change per frame, averaged over the same window.
    """

    states: VectorRepresentation
    actions: VectorRepresentation
    inputs: list[Array]
    outputs: list[Array]

    @cached_property
    def _squares(self) -> Array:
        """(E, I + S, I + S): the sums of products of each episode's inputs and outputs."""
        joined = (np.concatenate(pair, axis=1) for pair in zip(self.inputs, self.outputs, strict=True))
        return np.stack([rows.T @ rows for rows in joined])

    @cached_property
    def scale(self) -> Array:
        """(I + S,): root mean square of inputs and outputs; the dimensions of a vector share it."""
        ones, actions, states = ([0], self.actions.shared_scales, self.states.shared_scales)
        groups = np.concatenate([ones, 1 + np.array(actions), 1 + len(actions) + np.array(states)])
        power = np.diagonal(self._squares.sum(axis=0)) / sum(map(len, self.inputs))
        scale = np.sqrt([power[groups == group].mean() for group in groups])
        return np.where(scale > STILL, scale, np.inf)  # what does not move explains nothing

    @cached_property
    def products(self) -> Array:
        """(E, I + S, I + S): the sums of products of each episode's inputs and outputs over their scales."""
        return self._squares / (self.scale[:, None] * self.scale)


@dataclass(frozen=True)
class Consistency:
    """How the motion of one vector or scalar of the state follows from the actions.

    Fractions are of episodes that were held out: the median over resampled episodes.
    """

    labels: tuple[str, ...]
    """Its types in the declaration, such as `x` and `y`."""
    explained: float
    """Fraction of its motion that a linear map of the actions explains, at most 1."""
    contradicted: float
    """Fraction of the explained motion that no map explains which commutes with the transforms, in [0, 1]."""
    interval: tuple[float, float]
    """95 % interval of `contradicted`."""
    by_element: tuple[float, ...]
    """(G,) `contradicted` by the subgroup that each group element generates."""
    gains: NDArray[np.float64]
    """(len(labels), A) motion per unit of each dimension of the action, by the free map."""
    gain: float | None
    """Motion per unit of the action of the same types, by the map that commutes; None without such an action."""
    forbidden: tuple[float, ...]
    """(A,) root mean square of the motion that each dimension of the action causes against the declaration, relative to
    that of all motion."""

    @property
    def is_known(self) -> bool:
        """Whether the actions explain enough of the motion to say anything."""
        return self.explained >= LEAST_EXPLAINED

    @property
    def is_contradicted(self) -> bool:
        """Whether the demonstrations contradict the types."""
        return self.is_known and self.contradicted > CONTRADICTED and self.interval[0] > CONTRADICTED / 2


def motion(
    states: Sequence[NDArray[np.floating]],
    actions: Sequence[NDArray[np.floating]],
    state_types: VectorRepresentation,
    action_types: VectorRepresentation,
    mode: ActionMode = "delta",
    window: int = 1,
) -> Motion:
    """Return the actions of episodes and the motion of the state after them.

    Args:
        states: per episode (T, S), metres and radians.
        actions: per episode (T, A).
        state_types: types of the state.
        action_types: types of the action.
        mode: `delta` if an action moves the gripper from where it is, `absolute` if it says where the gripper shall be.
            An aperture is a target in both.
        window: frames over which actions and motion are averaged, so that noise in the state matters less.

    Raises:
        ValueError: if no episode is longer than the window.
    """
    targets = [*(MOVING if mode == "absolute" else ()), "aperture"]
    inputs, outputs = [], []
    for state, action in zip(states, actions, strict=True):
        change = np.diff(np.asarray(state, dtype=np.float64), axis=0)
        displacement = np.array(action[:-1], dtype=np.float64)
        if len(change) < window:
            continue
        for index, label in enumerate(action_types.dimensions):
            kind = label.split(":")[0]
            if kind in targets and label in state_types.dimensions:
                displacement[:, index] -= state[:-1, state_types.dimensions.index(label)]
                if kind == "yaw":
                    displacement[:, index] = _nearest(displacement[:, index])
        yaws = state_types.of_type("yaw")
        change[:, yaws] = _nearest(change[:, yaws])
        inputs.append(np.insert(_sliding(displacement, window) / window, 0, 1.0, axis=1))
        outputs.append(_sliding(change, window) / window)
    if not inputs:
        raise ValueError(f"no episode has more than {window} frames")
    return Motion(state_types, action_types, inputs, outputs)


def consistency(moved: Motion, group: PlanarGroup, seed: int = 0) -> list[Consistency]:
    """Return how far the motion contradicts the types, for each vector and scalar of the state that often moves.

    Args:
        moved: actions and the motion after them.
        group: the transforms that the types are about.
        seed: of the resamples.

    Raises:
        ValueError: if there are fewer than `LEAST_EPISODES` episodes.
    """
    count = len(moved.inputs)
    if count < LEAST_EPISODES:
        raise ValueError(f"the check needs {LEAST_EPISODES} episodes, got {count}")
    drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=RESAMPLES)
    drawn = drawn[(drawn == 0).any(axis=1)]
    seen, held_out = (np.tensordot(weights, moved.products, 1) for weights in (drawn, 1.0 * (drawn == 0)))
    found = []
    for rows in _blocks(moved.states):
        outputs = [moved.inputs[0].shape[1] + row for row in rows]
        moves = np.trace(held_out[:, outputs][:, :, outputs], axis1=1, axis2=2) > STILL
        if np.isfinite(moved.scale[outputs[0]]) and moves.mean() > 0.5:
            found.append(_consistency(moved, rows, group, seen[moves], held_out[moves]))
    return found


def _consistency(moved: Motion, rows: list[int], group: PlanarGroup, seen: Array, held_out: Array) -> Consistency:
    """Return the consistency of some dimensions of the state.

    Args:
        moved: actions and the motion after them.
        rows: indices of the dimensions.
        group: the transforms.
        seen: (R, I + S, I + S) sums of products from which the maps are estimated, of each resample.
        held_out: (R, I + S, I + S) those on which their errors are measured.
    """
    width = moved.inputs[0].shape[1]
    outputs = [width + row for row in rows]
    of_inputs = np.tile(np.eye(width), (group.size, 1, 1))
    of_inputs[:, 1:, 1:] = moved.actions.matrices(group)
    of_outputs = moved.states.matrices(group)[:, rows][:, :, rows]
    subgroups = [*(_generated(group, element) for element in range(group.size)), list(range(group.size))]
    bases = [_commuting(of_inputs[subgroup], of_outputs[subgroup]) for subgroup in subgroups]
    power = np.trace(held_out[:, outputs][:, :, outputs], axis1=1, axis2=2)
    errors = np.stack([_errors(_fit(basis, seen, outputs), held_out, outputs) for basis in bases])  # (G + 1, R)
    explained = np.maximum(power - errors[0], 1e-12 * power)  # the identity restricts nothing
    fractions = np.clip((errors - errors[0]) / explained, 0.0, 1.0)
    low, middle, high = np.percentile(fractions[-1], INTERVAL)
    total = moved.products.sum(axis=0, keepdims=True)
    free, bound = (_fit(bases[index], total, outputs)[0] for index in (0, -1))
    units = moved.scale[outputs, None] / moved.scale[1:width]
    same = [
        moved.actions.dimensions.index(moved.states.dimensions[row])
        for row in rows
        if moved.states.dimensions[row] in moved.actions.dimensions
    ]
    gain = float((bound[:, 1:] * units)[0, same[0]]) if len(same) == len(rows) else None
    spread = np.sqrt(np.diagonal(total[0])[1:width] / total[0, 0, 0])
    return Consistency(
        labels=tuple(moved.states.dimensions[row] for row in rows),
        explained=float(np.median(1 - errors[0] / power)),
        contradicted=float(middle),
        interval=(float(low), float(high)),
        by_element=tuple(np.median(fractions[:-1], axis=1).tolist()),
        gains=free[:, 1:] * units,
        gain=gain,
        forbidden=tuple((np.linalg.norm(free - bound, axis=0)[1:] * spread).tolist()),
    )


def _blocks(types: VectorRepresentation) -> list[list[int]]:
    """Return the indices of the dimensions of each vector and of each scalar, in order."""
    paired = {index: pair for pair in types.pairs for index in pair}
    return sorted({tuple(paired.get(index, (index,))) for index in range(len(types.dimensions))})  # type: ignore


def _generated(group: PlanarGroup, element: int) -> list[int]:
    """Return the subgroup that an element generates."""
    found = [0]
    while (following := int(group.product[element, found[-1]])) != 0:
        found.append(following)
    return found


def _commuting(of_inputs: Array, of_outputs: Array) -> Array:
    """Return a basis (K, O, I) of the maps that commute with representations (G, I, I) and (G, O, O)."""
    width, height = of_inputs.shape[1], of_outputs.shape[1]
    each = np.eye(height * width).reshape(-1, height, width)
    projected = np.einsum("gji,kjl,glm->kim", of_outputs, each, of_inputs) / len(of_inputs)
    values, vectors = np.linalg.eigh(projected.reshape(len(each), -1))  # a symmetric projection
    return vectors.T[values > 0.5].reshape(-1, height, width)


def _fit(basis: Array, products: Array, outputs: list[int]) -> Array:
    """Return the least-squares maps (R, O, I) in the span of a basis (K, O, I), of products (R, I + S, I + S)."""
    width = basis.shape[2]
    of_inputs, mixed = products[:, :width, :width], products[:, outputs, :width]
    normal = np.einsum("kij,rjm,lim->rkl", basis, of_inputs, basis)
    found = np.linalg.pinv(normal, rcond=SINGULAR, hermitian=True) @ np.einsum("kij,rij->rk", basis, mixed)[..., None]
    return np.einsum("rk,kij->rij", found[..., 0], basis)


def _errors(maps: Array, products: Array, outputs: list[int]) -> Array:
    """Return the sums of squared errors (R,) of maps (R, O, I), of sums of products (R, I + S, I + S)."""
    width = maps.shape[2]
    of_inputs, mixed = products[:, :width, :width], products[:, outputs, :width]
    power = np.trace(products[:, outputs][:, :, outputs], axis1=1, axis2=2)
    return power - 2 * (maps * mixed).sum(axis=(1, 2)) + np.einsum("rij,rjk,rik->r", maps, of_inputs, maps)


def _sliding(values: Array, window: int) -> Array:
    """Return the sums (T - window + 1, D) of `window` consecutive rows of values (T, D)."""
    return np.lib.stride_tricks.sliding_window_view(values, window, axis=0).sum(axis=-1)


def _nearest(angles: Array) -> Array:
    """Return differences between a parallel gripper's yaws in [-pi/2, pi/2)."""
    return (angles + np.pi / 2) % np.pi - np.pi / 2
