"""Lenses: where a camera with distortion shows the rays of an ideal pinhole camera, and the inverse.

Points are normalised: (x, y) = (X/Z, Y/Z) in the camera's frame, before K. Models and coefficients are OpenCV's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_symview.errors import CalibrationError

Array = NDArray[np.float64]

PLUMB_BOB, RATIONAL, EQUIDISTANT = "plumb_bob", "rational_polynomial", "equidistant"
COEFFICIENTS = {PLUMB_BOB: (4, 5), RATIONAL: (8,), EQUIDISTANT: (4,)}
"""Model of a lens, by its ROS name -> possible numbers of coefficients, in OpenCV's order."""
# Stored in datasets: do not reorder. A dataset that declares the model instead of storing it would not merge with one
# of another model, and a dataset of several cameras would need one declaration each.
NUMBERS = {PLUMB_BOB: 1, RATIONAL: 2, EQUIDISTANT: 3}
STORED = 9  # numbers in a dataset: the model's, then at most eight coefficients
WIDEST = np.deg2rad(89.5)  # from the optical axis: depth along the axis says nothing about rays at right angles to it
SAMPLES = 4096  # of the radial profile, up to `WIDEST`
STEPS = 30  # of Newton's method; from the profile it needs about four
CONVERGED = 1e-13  # normalised: 1e-10 pixels
CLOSE = 1e-10  # normalised: a ray whose pixel is farther off was not found


@dataclass(frozen=True)
class Lens:
    """A lens: model and coefficients of its distortion.

    Args:
        model: `plumb_bob` (k1, k2, p1, p2, k3), `rational_polynomial` (k1, k2, p1, p2, k3, k4, k5, k6) or
            `equidistant` (k1, k2, k3, k4), which is OpenCV's fisheye model.
        coefficients: in OpenCV's order; the last one of `plumb_bob` may be omitted.

    Raises:
        CalibrationError: if the model is unknown, or the coefficients are not finite or of another number.
    """

    model: str
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in COEFFICIENTS:
            raise CalibrationError(
                f"the lens model {self.model!r} is not supported, expected {', '.join(COEFFICIENTS)}: "
                "undistort the images"
            )
        values = tuple(float(value) for value in self.coefficients)
        if len(values) not in COEFFICIENTS[self.model]:
            counts = " or ".join(map(str, COEFFICIENTS[self.model]))
            raise CalibrationError(f"the lens model {self.model} has {counts} coefficients, got {len(values)}")
        if not np.isfinite(values).all():
            raise CalibrationError(f"distortion coefficients must be finite, got {values}")
        object.__setattr__(self, "coefficients", values)

    @property
    def is_pinhole(self) -> bool:
        """Whether the lens distorts nothing; an equidistant lens always does."""
        return self.model != EQUIDISTANT and not any(self.coefficients)

    @property
    def reach(self) -> float:
        """Largest distorted radius, normalised, before the lens folds back or reaches 89.5 degrees."""
        return float(_profile(self)[1][-1])

    def distort(self, points: ArrayLike) -> Array:
        """Map ideal points (..., 2) to distorted points (..., 2); both normalised, float64.

        A polynomial folds back far outside of the image for which it was fitted. Beyond the fold, and beyond 89.5
        degrees from the optical axis, it is continued linearly, so that what lies outside of the image stays outside.
        """
        points = np.asarray(points, dtype=np.float64)
        limit = _profile(self)[0][-1]
        with np.errstate(divide="ignore", invalid="ignore"):
            inside = np.minimum(1.0, limit / np.hypot(points[..., 0], points[..., 1]))[..., None]
            x, y = np.moveaxis(points * inside, -1, 0)
            return np.stack(_distorted(self, x, y)[:2], axis=-1) / inside

    def undistort(self, points: ArrayLike) -> Array:
        """Map distorted points (..., 2) to ideal points (..., 2), both normalised, float64: the inverse of `distort`.

        Newton's method, until a step is below 1e-10 pixels. NaN where the lens shows no ray within its limits.
        """
        points = np.asarray(points, dtype=np.float64)
        radii, distorted = _profile(self)
        radius = np.hypot(points[..., 0], points[..., 1])
        scale = np.divide(np.interp(radius, distorted, radii), radius, out=np.ones_like(radius), where=radius > 0)
        x, y = np.moveaxis(points * scale[..., None], -1, 0)
        with np.errstate(all="ignore"):  # points that no ray reaches
            for _ in range(STEPS):
                at_x, at_y, (a, b, c) = _distorted(self, x, y)
                dx, dy = at_x - points[..., 0], at_y - points[..., 1]
                determinant = a * c - b * b
                step_x, step_y = (c * dx - b * dy) / determinant, (a * dy - b * dx) / determinant
                x, y = x - step_x, y - step_y
                if not (np.abs(step_x) + np.abs(step_y) > CONVERGED).any():
                    break
            at_x, at_y, _ = _distorted(self, x, y)
            error = np.abs(at_x - points[..., 0]) + np.abs(at_y - points[..., 1])
            known = (error < CLOSE) & (np.hypot(x, y) <= radii[-1])
        return np.where(known[..., None], np.stack([x, y], axis=-1), np.nan)

    def stored(self) -> Array:
        """Return the numbers (9,) that `stored_lens` reads: the model's number, then the coefficients and zeros."""
        numbers = np.zeros(STORED)
        numbers[: 1 + len(self.coefficients)] = [NUMBERS[self.model], *self.coefficients]
        return numbers


def lens_from_coefficients(model: str | None, coefficients: ArrayLike) -> Lens | None:
    """Return the lens of a calibration; None if all its coefficients are zero. Trailing zeros count as absent.

    A lens that is named `equidistant` and has four zeros is one, as in OpenCV: its radius is the angle.

    Args:
        model: as for `Lens`; by default `rational_polynomial` for 8 coefficients and `plumb_bob` for fewer.
        coefficients: in OpenCV's order.

    Raises:
        CalibrationError: for the same reasons as `Lens`.
    """
    values: Array = np.asarray(coefficients, dtype=np.float64).ravel()
    if not values.any() and (model != EQUIDISTANT or not values.size):
        return None
    most = max(COEFFICIENTS.get(model, (0,))) if model else 8
    if len(values) > most > 0 and not values[most:].any():
        values = values[:most]
    return Lens(model or (RATIONAL if len(values) == 8 else PLUMB_BOB), tuple(values.tolist()))


def stored_lens(numbers: NDArray) -> Lens | None:
    """Return the lens that a dataset or an observation stores as `Lens.stored` gives it; None for a pinhole camera.

    Raises:
        CalibrationError: if the numbers are not those of a lens.
    """
    values = np.asarray(numbers, dtype=np.float64).ravel()
    if len(values) != STORED:
        raise CalibrationError(f"a stored distortion has {STORED} numbers, got {len(values)}")
    if not values.any():
        return None
    models = {float(number): model for model, number in NUMBERS.items()}
    if values[0] not in models:
        listed = ", ".join(f"{number} {model}" for model, number in NUMBERS.items())
        raise CalibrationError(f"a stored distortion starts with its model, 0 none, {listed}, got {values[0]:g}")
    model = models[values[0]]
    count = max(COEFFICIENTS[model])
    if values[1 + count :].any():
        raise CalibrationError(f"a stored {model} lens has {count} coefficients, then zeros, got {values[1:]}")
    return Lens(model, tuple(values[1 : 1 + count].tolist()))


@lru_cache(maxsize=256)
def _profile(lens: Lens) -> tuple[Array, Array]:
    """Return radii (N,), from 0 to the largest that the lens shows, and the distorted radii (N,), both growing."""
    radii = np.tan(np.linspace(0.0, WIDEST, SAMPLES))
    with np.errstate(all="ignore"):  # a pole of the rational model
        distorted = radii * _scale(lens, radii**2)[0]
    growing = np.diff(distorted) > 0
    count = SAMPLES if growing.all() else int(np.argmin(growing)) + 1
    return radii[:count], distorted[:count]


def _distorted(lens: Lens, x: Array, y: Array) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Return the distorted x and y, and their derivatives dx/dx, dx/dy = dy/dx, dy/dy."""
    p1, p2 = (0.0, 0.0) if lens.model == EQUIDISTANT else lens.coefficients[2:4]
    xx, xy, yy = x * x, x * y, y * y
    square = xx + yy
    scale, slope = _scale(lens, square)
    across = 2 * slope * xy + 2 * (p1 * x + p2 * y)
    return (
        x * scale + 2 * p1 * xy + p2 * (square + 2 * xx),
        y * scale + p1 * (square + 2 * yy) + 2 * p2 * xy,
        (
            scale + 2 * slope * xx + 2 * p1 * y + 6 * p2 * x,
            across,
            scale + 2 * slope * yy + 6 * p1 * y + 2 * p2 * x,
        ),
    )


def _scale(lens: Lens, square: Array) -> tuple[Array, Array]:
    """Return the distorted radius over the radius, and its derivative, as functions of the radius' square."""
    if lens.model == EQUIDISTANT:
        return _equidistant_scale(lens.coefficients, square)
    k1, k2, _, _, k3, k4, k5, k6 = *lens.coefficients, *(8 - len(lens.coefficients)) * (0.0,)
    over = 1 + square * (k1 + square * (k2 + square * k3))
    under = 1 + square * (k4 + square * (k5 + square * k6))
    over_slope = k1 + square * (2 * k2 + 3 * k3 * square)
    under_slope = k4 + square * (2 * k5 + 3 * k6 * square)
    return over / under, (over_slope * under - over * under_slope) / (under * under)


def _equidistant_scale(coefficients: tuple[float, ...], square: Array) -> tuple[Array, Array]:
    k1, k2, k3, k4 = coefficients
    radius = np.sqrt(square)
    angle = np.arctan(radius)
    turn = angle * angle
    distorted = angle * (1 + turn * (k1 + turn * (k2 + turn * (k3 + turn * k4))))
    growth = 1 + turn * (3 * k1 + turn * (5 * k2 + turn * (7 * k3 + turn * 9 * k4)))
    near = square < 1e-8  # where the quotients are 0 / 0
    radius, divisor = np.where(near, 1.0, radius), np.where(near, 1.0, square)
    scale = np.where(near, 1 + (k1 - 1 / 3) * square, distorted / radius)
    return scale, np.where(near, k1 - 1 / 3, (growth / (1 + square) - scale) / (2 * divisor))
