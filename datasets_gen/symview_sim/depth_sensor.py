"""Noise, missing and flying pixels of a stereo depth camera, added to exact depth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

JUMP = 0.02  # metres between neighbouring pixels: a depth discontinuity
EDGE_FACTOR = 10.0


def degrade(
    depth: NDArray[np.float32], noise: float, dropout: float, rng: np.random.Generator, flying: float = 0.0
) -> NDArray[np.float32]:
    """Return the depth that a stereo camera would measure.

    Disparity is f B / z and has the same error, in pixels, everywhere. The depth error therefore grows with z^2
    (Khoshelham and Elberink 2012, Eq. 6). Pixels beside a depth discontinuity have no match in the other image.

    Args:
        depth: (H, W) float32, metres along the optical axis, 0 = invalid.
        noise: standard deviation at 1 m, metres.
        dropout: share of pixels without depth, ten times as large beside a discontinuity of 2 cm or more.
        rng: source of randomness.
        flying: share of the pixels beside a discontinuity whose depth lies between those of the two surfaces.

    Returns:
        (H, W) float32, metres, 0 = invalid.
    """
    beside = _beside_discontinuities(depth) if max(flying, dropout) > 0 else np.zeros(depth.shape, dtype=bool)
    if flying > 0:
        depth = _with_flying_pixels(depth, beside, flying, rng)
    measured = depth + noise * depth**2 * rng.standard_normal(depth.shape)
    if dropout > 0:
        lost = rng.random(depth.shape)
        lost[beside] /= EDGE_FACTOR
        measured[lost < dropout] = 0.0
    return np.where(depth > 0, np.maximum(measured, 0.0), 0.0).astype(np.float32)


def _beside_discontinuities(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return (H, W) bool: whether a pixel is next to a depth discontinuity in its row or column."""
    beside = np.zeros(depth.shape, dtype=bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(depth, axis=axis)) > JUMP
        first, second = [slice(None)] * 2, [slice(None)] * 2
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        beside[tuple(first)] |= jump
        beside[tuple(second)] |= jump
    return beside


def _with_flying_pixels(
    depth: NDArray[np.float32], beside: NDArray[np.bool_], share: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Return depth in which some of the pixels `beside` discontinuities have a depth between their neighbours'."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(depth, 1, mode="edge"), (3, 3))
    nearest, farthest = around.min(axis=(2, 3)), around.max(axis=(2, 3))
    flies = beside & (nearest > 0) & (rng.random(depth.shape) < share)
    weight = rng.random(depth.shape, dtype=np.float32)
    return np.where(flies, nearest + weight * (farthest - nearest), depth)
