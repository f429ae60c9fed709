"""Units of depth and height images. Dataset readers and the policies' first processor step convert all to metres."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Unit = Literal["m", "mm"]
UNIT_NAMES: dict[Unit, str] = {"m": "metres", "mm": "millimetres"}
MILLIMETRES_PER_METRE = 1000.0
METRES_AT_MOST = 10.0  # table scenes have no larger value in metres, and cameras measure no depth below 10 mm


def in_metres(depth: NDArray, unit: Unit | None = None) -> NDArray[np.floating]:
    """Convert a depth or height image to metres.

    Args:
        depth: any shape, float or integer.
        unit: unit of `depth`; None is LeRobot's convention, float metres and integer millimetres (as from a RealSense).

    Returns:
        The same shape; float32 for integer input, else the dtype of `depth`.
    """
    is_float = np.issubdtype(depth.dtype, np.floating)
    if unit == "m" or (unit is None and is_float):
        return depth if is_float else depth.astype(np.float32)
    return (depth if is_float else depth.astype(np.float32)) / np.float32(MILLIMETRES_PER_METRE)


def infer_depth_unit(depth: Any) -> Unit:
    """Return the most likely unit of depth images whose feature declares none.

    Integers are millimetres. Floats are millimetres if most valid pixels exceed 10: a camera over a table measures no
    depth below 10 mm and few beyond 10 m. The majority decides, so that outliers do not matter.

    Args:
        depth: any shape, NumPy array or torch tensor; 0, negative or non-finite = invalid.
    """
    xp = _array_namespace(depth)
    if not xp.isdtype(depth.dtype, "real floating"):
        return "mm"
    valid = xp.isfinite(depth) & (depth > 0)
    large = valid & (depth > METRES_AT_MOST)
    return "mm" if bool(2 * xp.sum(large) > xp.sum(valid)) else "m"


def infer_height_unit(heights: Any) -> Unit:
    """Return the most likely unit of height maps whose feature declares none.

    Floats are millimetres if any height exceeds 10: most of a table is empty, so the majority cannot decide. A map in
    millimetres without such a height shows no object higher than 1 cm.

    Args:
        heights: any shape, NumPy array or torch tensor; height above the table.
    """
    xp = _array_namespace(heights)
    if not xp.isdtype(heights.dtype, "real floating"):
        return "mm"
    return "mm" if bool(xp.any(xp.isfinite(heights) & (heights > METRES_AT_MOST))) else "m"


def _array_namespace(array: Any) -> Any:
    import array_api_compat  # here, since it is a fifth of the time that importing the plugin takes

    return array_api_compat.array_namespace(array)
