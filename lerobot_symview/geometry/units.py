"""Units of depth and height images. Dataset readers and the policies' first processor step convert all to metres.

A unit is a number: metres per stored unit.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

METRES, MILLIMETRES = 1.0, 0.001
UNIT_NAMES = {"m": METRES, "mm": MILLIMETRES}
VIDEO_MINIMUM = 0.01  # metres, LeRobot's default `depth_min`: the depth that its depth videos show for invalid pixels
ABOVE_MINIMUM = 1.01  # times the minimum: above rounding, and below the next code of a depth video
METRES_AT_MOST = 10.0  # table scenes have no larger value in metres, and cameras measure no depth below 10 mm


def parse_unit(value: Any) -> float:
    """Return the metres per unit of `m`, `mm`, or a positive number such as 0.0001, also as text.

    Raises:
        ValueError: if `value` is none of them.
    """
    try:
        unit = UNIT_NAMES[value] if value in UNIT_NAMES else float(value)
    except (TypeError, ValueError):
        unit = math.nan
    if isinstance(value, bool) or not 0 < unit < math.inf:
        raise ValueError(f"a depth unit must be m, mm or a positive number of metres such as 0.0001, got {value!r}")
    return unit


def unit_name(unit: float) -> str:
    """Return a unit in words."""
    return {METRES: "metres", MILLIMETRES: "millimetres"}.get(unit, f"units of {unit:g} m")


def in_metres(depth: NDArray, unit: float | None = None) -> NDArray[np.floating]:
    """Convert a depth or height image to metres.

    Args:
        depth: any shape, float or integer.
        unit: metres per unit of `depth`; None is LeRobot's convention, float metres and integer millimetres.

    Returns:
        The same shape; float32 for integer input, else the dtype of `depth`.
    """
    is_float = np.issubdtype(depth.dtype, np.floating)
    if unit is None:
        unit = METRES if is_float else MILLIMETRES
    depth = depth if is_float else depth.astype(np.float32)
    return depth if unit == METRES else depth / np.float32(units_per_metre(unit))


def units_per_metre(unit: float) -> float:
    """Return the divisor that converts to metres: a whole number where the unit is a fraction of a metre."""
    divisor = 1 / unit
    return round(divisor) if math.isclose(divisor, round(divisor)) else divisor


def infer_depth_unit(depth: Any) -> float:
    """Return the most likely unit of depth images whose feature declares none, from their values alone.

    Integers are millimetres. Floats are millimetres if most valid pixels exceed 10: a camera over a table measures no
    depth below 10 mm and few beyond 10 m. The majority decides, so that outliers do not matter. Exactly 10 mm, with
    which depth videos show invalid pixels, does not count.

    Args:
        depth: any shape, NumPy array or torch tensor; 0, negative or non-finite = invalid.
    """
    xp = _array_namespace(depth)
    if not xp.isdtype(depth.dtype, "real floating"):
        return MILLIMETRES
    valid = xp.isfinite(depth) & (depth > 0)
    for minimum in (VIDEO_MINIMUM, VIDEO_MINIMUM / MILLIMETRES):
        valid = valid & (xp.abs(depth - minimum) > minimum * (ABOVE_MINIMUM - 1))
    large = valid & (depth > METRES_AT_MOST)
    return MILLIMETRES if bool(2 * xp.sum(large) > xp.sum(valid)) else METRES


def infer_height_unit(heights: Any) -> float:
    """Return the most likely unit of height maps whose feature declares none.

    Floats are millimetres if any height exceeds 10: most of a table is empty, so the majority cannot decide. A map in
    millimetres without such a height shows no object higher than 1 cm.

    Args:
        heights: any shape, NumPy array or torch tensor; height above the table.
    """
    xp = _array_namespace(heights)
    if not xp.isdtype(heights.dtype, "real floating"):
        return MILLIMETRES
    return MILLIMETRES if bool(xp.any(xp.isfinite(heights) & (heights > METRES_AT_MOST))) else METRES


def _array_namespace(array: Any) -> Any:
    import array_api_compat  # here, since it is a fifth of the time that importing the plugin takes

    return array_api_compat.array_namespace(array)
