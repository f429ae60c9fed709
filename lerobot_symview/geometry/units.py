"""Units of depth and height images. Behind a dataset's reader or a policy's first processor step all are metres."""

from __future__ import annotations

from typing import Any, Literal

import array_api_compat
import numpy as np
from numpy.typing import NDArray

Unit = Literal["m", "mm"]
UNIT_NAMES: dict[Unit, str] = {"m": "metres", "mm": "millimetres"}
MILLIMETRES_PER_METRE = 1000.0
METRES_AT_MOST = 10.0  # nothing on a table is farther or higher, and nothing is seen from as many millimetres


def in_metres(depth: NDArray, unit: Unit | None = None) -> NDArray[np.floating]:
    """Convert a depth or height image to metres.

    Args:
        depth: any shape, float or integer.
        unit: of `depth`; None is LeRobot's convention, float metres and integer millimetres (as a RealSense delivers).

    Returns:
        The same shape; float32 from integers, else the dtype of `depth`.
    """
    is_float = np.issubdtype(depth.dtype, np.floating)
    if unit == "m" or (unit is None and is_float):
        return depth if is_float else depth.astype(np.float32)
    return (depth if is_float else depth.astype(np.float32)) / np.float32(MILLIMETRES_PER_METRE)


def infer_depth_unit(depth: Any) -> Unit:
    """Return the unit that depth images, of a kind that declares none, are most likely in.

    Integers are millimetres. Floats are millimetres if most valid pixels exceed 10: a camera over a table sees nothing
    at 10 mm and little at 10 m, and a few wrong pixels change nothing.

    Args:
        depth: any shape, NumPy array or torch tensor; 0, negative or non-finite = invalid.
    """
    xp = array_api_compat.array_namespace(depth)
    if not xp.isdtype(depth.dtype, "real floating"):
        return "mm"
    valid = xp.isfinite(depth) & (depth > 0)
    large = valid & (depth > METRES_AT_MOST)
    return "mm" if bool(2 * xp.sum(large) > xp.sum(valid)) else "m"


def infer_height_unit(heights: Any) -> Unit:
    """Return the unit that height maps, of a kind that declares none, are most likely in.

    Most of a table is bare, so one height above 10 decides, not the majority. Millimetres without any show nothing
    higher than 1 cm.

    Args:
        heights: any shape, NumPy array or torch tensor, above the table.
    """
    xp = array_api_compat.array_namespace(heights)
    if not xp.isdtype(heights.dtype, "real floating"):
        return "mm"
    return "mm" if bool(xp.any(xp.isfinite(heights) & (heights > METRES_AT_MOST))) else "m"
