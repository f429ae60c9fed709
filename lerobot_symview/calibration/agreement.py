"""Whether the calibrations of several cameras agree: what both see is at one height."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.workspace import Workspace

logger = logging.getLogger(__name__)

CONTRADICTION = 0.25  # share of cells; with right calibrations it is up to 0.14, see `fusion.disagreement`


def report_agreement(
    depths: Mapping[str, NDArray[np.floating]],
    cameras: Mapping[str, Camera],
    workspace: Workspace,
    ceiling: float | None = None,
) -> float:
    """Log where cameras measure heights that differ by more than 1 cm, as a warning if a calibration must be wrong.

    Args:
        depths: camera -> (H, W) float, metres along the optical axis; invalid values are ignored.
        cameras: camera -> its calibration.
        workspace: the square on the table.
        ceiling: metres above the table; higher points, such as those of the arm, are ignored.

    Returns:
        The share of the compared cells, from 0 to 1 (`lerobot_symview.geometry.fusion.disagreement`).
    """
    from lerobot_symview.geometry.fusion import disagreement  # slow import: numba

    share = disagreement(
        [*depths.values()], [cameras[name] for name in depths], workspace, np.inf if ceiling is None else ceiling
    )
    is_wrong = share > CONTRADICTION
    logger.log(
        logging.WARNING if is_wrong else logging.INFO,
        "cameras %s measure heights that differ by more than 1 cm in %.0f %% of what they both see%s",
        ", ".join(depths),
        100 * share,
        ": check their calibrations" if is_wrong else "",
    )
    return share
