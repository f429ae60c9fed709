"""The flaws of a stereo depth camera, added to exact depth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

JUMP = 0.02  # metres between neighbouring pixels: one surface ends and another begins
EDGE_FACTOR = 10.0


def degrade(depth: NDArray[np.float32], noise: float, dropout: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return what a stereo camera would have measured.

    Its disparity is f B / z and its error in pixels is the same everywhere, so depth errs by an amount that grows with
    z^2 (Khoshelham and Elberink 2012, Eq. 6); pixels beside a jump of depth find no partner in the other image.

    Args:
        depth: (H, W) float32, metres along the optical axis, 0 = invalid.
        noise: standard deviation at 1 m, metres.
        dropout: share of the pixels lost, ten times as large beside a jump of 2 cm.
        rng: source of randomness.

    Returns:
        (H, W) float32, metres, 0 where nothing is measured.
    """
    measured = depth + noise * depth**2 * rng.standard_normal(depth.shape)
    if dropout > 0:
        lost = rng.random(depth.shape)
        lost[_beside_jumps(depth)] /= EDGE_FACTOR
        measured[lost < dropout] = 0.0
    return np.where(depth > 0, np.maximum(measured, 0.0), 0.0).astype(np.float32)


def _beside_jumps(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W) whether depth jumps between a pixel and the next one in its row or column."""
    beside = np.zeros(depth.shape, dtype=bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(depth, axis=axis)) > JUMP
        first, second = [slice(None)] * 2, [slice(None)] * 2
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        beside[tuple(first)] |= jump
        beside[tuple(second)] |= jump
    return beside
