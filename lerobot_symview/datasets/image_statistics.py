"""Statistics over all pixels of many images, from histograms: nothing is sampled, and parts can be added up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
SUMMARY = ("min", "max", "mean", "std", *QUANTILES)
LOWEST, HIGHEST, STEP = -0.5, 1.5, 1e-4  # metres: what lies outside counts, for quantiles, as lying at the border
PER_METRE = round(1 / STEP)
LEVELS = LOWEST + STEP * np.arange(round((HIGHEST - LOWEST) / STEP) + 1)


@dataclass(eq=False)
class ImageStatistics:
    """What is known of the images seen so far.

    Colour's quantiles are exact; those of metres are multiples of 0.1 mm. Everything else is exact up to rounding.

    Args:
        kind: `rgb` for (H, W, 3) uint8, counted in levels of 1/255 as LeRobot does, or `height` for (H, W) float32.
        images: how many.
        counts: (C, bins) int64, pixels per level.
        sums: (C, 4) float64: minimum, maximum, sum and sum of squares.
    """

    kind: Literal["rgb", "height"]
    images: int
    counts: NDArray[np.int64]
    sums: NDArray[np.float64]

    @classmethod
    def empty(cls, kind: Literal["rgb", "height"]) -> Self:
        """Return the statistics of no image."""
        channels, bins = (3, 256) if kind == "rgb" else (1, len(LEVELS))
        sums = np.tile([np.inf, -np.inf, 0.0, 0.0], (channels, 1))
        return cls(kind, 0, np.zeros((channels, bins), dtype=np.int64), sums)

    def add(self, image: NDArray) -> None:
        """Count one image."""
        self.images += 1
        if self.kind == "rgb":
            _count_levels(image, self.counts)  # from which the rest follows
        else:
            _count_metres(image, self.counts[0], self.sums[0])

    def merge(self, other: Self) -> None:
        """Count what `other` has counted."""
        self.images += other.images
        self.counts += other.counts
        self.sums[:, 0] = np.minimum(self.sums[:, 0], other.sums[:, 0])
        self.sums[:, 1] = np.maximum(self.sums[:, 1], other.sums[:, 1])
        self.sums[:, 2:] += other.sums[:, 2:]

    def summary(self) -> NDArray[np.float64]:
        """Return what `SUMMARY` names of every channel: (9, C) float64."""
        total = self.counts.sum(axis=1)
        if self.kind == "rgb":
            levels: NDArray = np.arange(256) / 255
            seen = self.counts > 0
            minimum, maximum = levels[seen.argmax(axis=1)], levels[255 - seen[:, ::-1].argmax(axis=1)]
            mean = self.counts @ levels / total
            variance = self.counts @ levels**2 / total - mean**2
        else:
            levels = LEVELS
            minimum, maximum = self.sums[:, 0], self.sums[:, 1]
            mean = self.sums[:, 2] / total
            variance = self.sums[:, 3] / total - mean**2
        ranks = np.ceil(np.outer(list(QUANTILES.values()), total)).astype(np.int64)
        quantiles = levels[_bins(self.counts, ranks)]
        return np.concatenate([[minimum, maximum, mean, np.sqrt(np.maximum(variance, 0.0))], quantiles])


def image_summary(summary: NDArray[np.float64], images: Any) -> dict[str, Any]:
    """Return LeRobot's statistics of image features, from one summary or from many.

    Args:
        summary: (..., 9, C), by `ImageStatistics.summary`.
        images: (...) how many images each is of.

    Returns:
        Lists of shape (..., C, 1, 1), and of shape (..., 1) the number of images.
    """
    values = np.moveaxis(summary, -2, 0)[..., None, None]
    named = {name: value.tolist() for name, value in zip(SUMMARY, values, strict=True)}
    return named | {"count": np.asarray(images)[..., None].tolist()}


def constant_summary(values: NDArray[np.floating], count: int) -> dict[str, Any]:
    """Return LeRobot's statistics of a feature that is `values` (N,) in each of `count` frames."""
    same = {name: values.tolist() for name in ("min", "max", "mean", *QUANTILES)}
    return same | {"std": np.zeros_like(values).tolist(), "count": [count]}


@njit(cache=True, nogil=True)
def _bins(counts, ranks):  # type: ignore[no-untyped-def]
    """Return in which bin of counts (C, bins) each of the ranks (N, C), ascending and from 1, lies: (N, C)."""
    bins = np.empty(ranks.shape, np.int64)
    for channel in range(len(counts)):
        reached, level = counts[channel, 0], 0
        for i in range(len(ranks)):
            while reached < ranks[i, channel]:
                level += 1
                reached += counts[channel, level]
            bins[i, channel] = level
    return bins


@njit(cache=True, nogil=True)
def _count_levels(image, counts):  # type: ignore[no-untyped-def]
    red, green, blue = counts
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            red[image[i, j, 0]] += 1
            green[image[i, j, 1]] += 1
            blue[image[i, j, 2]] += 1


@njit(cache=True, nogil=True)
def _count_metres(image, counts, sums):  # type: ignore[no-untyped-def]
    minimum, maximum, total, squares = sums
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            value = np.float64(image[i, j])
            minimum, maximum = min(minimum, value), max(maximum, value)
            total += value
            squares += value * value
            level = int((min(max(value, LOWEST), HIGHEST) - LOWEST) * PER_METRE + 0.5)
            counts[level] += 1
    sums[0], sums[1], sums[2], sums[3] = minimum, maximum, total, squares
