"""The square on the table that a top-down image shows, and its pixel grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.camera import Array, Camera, project


@dataclass(frozen=True)
class Workspace:
    """A square, axis-aligned working area on the table z = 0.

    Raises:
        OptionError: if a value is not finite, or a length is not positive.
    """

    center: tuple[float, float] = (0.45, 0.0)
    """x and y of the square's centre in the world frame, metres."""
    size: float = 0.4
    """Side T of the square, metres."""
    height_limit: float = 0.25
    """Height of the working volume above the table, metres."""

    def __post_init__(self) -> None:
        if not np.isfinite([*self.center, self.size, self.height_limit]).all():
            raise OptionError(f"workspace values must be finite, got {self}")
        if self.size <= 0 or self.height_limit <= 0:
            raise OptionError(
                f"workspace size and height_limit must be positive metres, got {self.size:g} and {self.height_limit:g}"
            )

    def pixel_from_xy(self, xy: Array, pixels: int) -> Array:
        """Map world x, y (..., 2) to continuous (row, column) (..., 2) of a pixels x pixels top-down image.

        Paper Eq. 5-6, with integer coordinates at pixel centres: rows grow with x, columns with y.
        """
        return pixels * ((xy - np.asarray(self.center)) / self.size + 0.5) - 0.5

    def xy_from_pixel(self, pixel: Array, pixels: int) -> Array:
        """Map (row, column) (..., 2) to world x, y (..., 2); inverse of `pixel_from_xy`."""
        return np.asarray(self.center) + ((np.asarray(pixel) + 0.5) / pixels - 0.5) * self.size

    def corners(self, height: float = 0.0) -> Array:
        """(4, 3) world points: the corners at `height` metres, in the order of image corners TL, TR, BR, BL."""
        half = self.size / 2
        offsets = np.array([[-half, -half], [-half, half], [half, half], [half, -half]])
        return np.column_stack([offsets + self.center, np.full(4, float(height))])

    def visible_fraction(self, camera: Camera, samples: int = 9) -> float:
        """Fraction of the working volume (a samples^3 grid, borders included) that projects into the image."""
        half = self.size / 2
        axes = (
            np.linspace(self.center[0] - half, self.center[0] + half, samples),
            np.linspace(self.center[1] - half, self.center[1] + half, samples),
            np.linspace(0.0, self.height_limit, samples),
        )
        pixels, depth = project(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1), camera)
        inside = (pixels >= -0.5) & (pixels <= [camera.width - 0.5, camera.height - 0.5])
        return float((inside.all(axis=-1) & (depth > 0)).mean())
