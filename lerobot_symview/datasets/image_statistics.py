"""Statistics over all pixels of many images, from histograms that can be merged; no pixels are subsampled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
SUMMARY = ("min", "max", "mean", "std", *QUANTILES)
LOWEST, HIGHEST, STEP = -0.5, 1.5, 1e-4  # metres: values outside count in the border bins, for quantiles
PER_METRE = round(1 / STEP)
LEVELS = LOWEST + STEP * np.arange(round((HIGHEST - LOWEST) / STEP) + 1)


@dataclass(eq=False)
class ImageStatistics:
    """Histograms and moments of a set of images.

    Quantiles of colours are exact; quantiles of heights are multiples of 0.1 mm. All other values are exact up to
    rounding.

    Args:
        kind: `rgb` for (H, W, 3) uint8, with levels of 1/255 as in LeRobot, or `height` for (H, W) float32, metres.
        images: number of images.
        counts: (C, bins) int64, pixels per bin.
        sums: (C, 4) float64: minimum, maximum, sum and sum of squares.
    """

    kind: Literal["rgb", "height"]
    images: int
    counts: NDArray[np.int64]
    sums: NDArray[np.float64]

    @classmethod
    def empty(cls, kind: Literal["rgb", "height"]) -> Self:
        """Return the statistics of an empty set of images."""
        channels, bins = (3, 256) if kind == "rgb" else (1, len(LEVELS))
        sums = np.tile([np.inf, -np.inf, 0.0, 0.0], (channels, 1))
        return cls(kind, 0, np.zeros((channels, bins), dtype=np.int64), sums)

    def add(self, image: NDArray) -> None:
        """Add one image."""
        self.images += 1
        if self.kind == "rgb":
            _count_levels(image, self.counts)  # minimum, maximum and moments follow from the counts
        else:
            _count_metres(image, self.counts[0], self.sums[0])

    def merge(self, other: Self) -> None:
        """Add the images of `other`."""
        self.images += other.images
        self.counts += other.counts
        self.sums[:, 0] = np.minimum(self.sums[:, 0], other.sums[:, 0])
        self.sums[:, 1] = np.maximum(self.sums[:, 1], other.sums[:, 1])
        self.sums[:, 2:] += other.sums[:, 2:]

    def summary(self) -> NDArray[np.float64]:
        """Return the statistics named in `SUMMARY` per channel: (9, C) float64."""
        total = self.counts.sum(axis=1)
        if self.kind == "rgb":
            levels: NDArray = np.arange(256) / 255
            occupied = self.counts > 0
            minimum, maximum = levels[occupied.argmax(axis=1)], levels[255 - occupied[:, ::-1].argmax(axis=1)]
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
    """Return one or more summaries as LeRobot's statistics of image features.

    Args:
        summary: (..., 9, C), from `ImageStatistics.summary`.
        images: (...), number of images of each summary.

    Returns:
        Lists of shape (..., C, 1, 1) by name, and `count` of shape (..., 1).
    """
    values = np.moveaxis(summary, -2, 0)[..., None, None]
    named = {name: value.tolist() for name, value in zip(SUMMARY, values, strict=True)}
    return named | {"count": np.asarray(images)[..., None].tolist()}


def constant_summary(values: NDArray[np.floating], count: int) -> dict[str, Any]:
    """Return LeRobot's statistics of a feature with the constant `values` (N,) in `count` frames."""
    same = {name: values.tolist() for name in ("min", "max", "mean", *QUANTILES)}
    return same | {"std": np.zeros_like(values).tolist(), "count": [count]}


def vector_summary(values: NDArray[np.floating]) -> dict[str, Any]:
    """Return LeRobot's statistics of a feature with values (N, D) in N frames."""
    values = values.astype(np.float64)
    named = {name: getattr(values, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0).tolist()
    return named | dict(zip(QUANTILES, quantiles, strict=True)) | {"count": [len(values)]}


@njit(cache=True, nogil=True)
def _bins(counts, ranks):  # type: ignore[no-untyped-def]
    """Return the bin of counts (C, bins) that holds each of the ranks (N, C), ascending from 1: (N, C) int64."""
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
