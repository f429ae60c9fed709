"""What a robot's numbers of its joints mean: degrees, radians, or LeRobot's ranges by its calibration of the motors."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.errors import KinematicsError
from lerobot_symview.kinematics.arm import Arm
from lerobot_symview.kinematics.model import ArmModel, Array

JointUnits = Literal["degrees", "radians", "normalized"]
UNITS: tuple[JointUnits, ...] = ("degrees", "radians", "normalized")
STEPS = 4095  # of a turn: the highest position of the motors that LeRobot's arms have
FULL = 100.0  # LeRobot's normalised range is -100 to 100
SMALL = np.pi * 1.02  # numbers that never exceed it are radians, or the arm hardly moves
BEYOND = np.deg2rad(10.0)  # of a limit, before a position is wrong; arms are assembled by hand
FEW = 0.01  # fraction of the frames that may be wrong


def joint_scales(
    model: ArmModel,
    joints: Sequence[str],
    units: JointUnits,
    motors: Path | None = None,
    signs: Mapping[str, float] | None = None,
    offsets: Mapping[str, float] | None = None,
) -> tuple[Array, Array]:
    """Return the scale and offset (J,) of `Arm`.

    Args:
        model: the arm.
        joints: the robot's name of each of its joints.
        units: of its angles; prismatic joints are in metres, unless normalised.
        motors: LeRobot's calibration file of the arm, for `normalized`.
        signs: joint -> 1 or -1, where it turns the other way than the model's.
        offsets: joint -> degrees (or metres) of the model at the robot's 0.

    Raises:
        KinematicsError: if a joint is unknown, a value is invalid, or the file is missing or malformed.
    """
    if units not in UNITS:
        raise KinematicsError(f"units must be one of {', '.join(UNITS)}, got {units!r}")
    signs, offsets = signs or {}, offsets or {}
    for kind, given in (("signs", signs), ("offsets", offsets)):
        unknown = [name for name in given if name not in joints]
        if unknown:
            raise KinematicsError(f"{kind} names {', '.join(unknown)}, the joints are {', '.join(joints)}")
    wrong = [f"{name}={sign}" for name, sign in signs.items() if sign not in (1, -1)]
    if wrong:
        raise KinematicsError(f"signs must be 1 or -1, got {', '.join(wrong)}")
    angle = np.where(model.is_revolute, np.deg2rad(1.0), 1.0)
    scale = angle if units == "degrees" else np.ones(len(joints))
    if units == "normalized":
        if not model.is_revolute.all():
            raise KinematicsError("normalized joints must be revolute")
        scale = _normalized(joints, motors, signs)
    elif motors is not None:
        raise KinematicsError(f"units are {units}: a calibration of the motors is for normalized ones")
    return (
        scale * [float(signs.get(name, 1)) for name in joints],
        angle * [float(offsets.get(name, 0.0)) for name in joints],
    )


def _normalized(joints: Sequence[str], motors: Path | None, signs: Mapping[str, float]) -> Array:
    """Return the radians per unit of LeRobot's -100 to 100, whose 0 is the middle of a motor's range."""
    if motors is None:
        raise KinematicsError(
            "normalized joints need LeRobot's calibration file of the arm, calibration/robots/<type>/<id>.json, which "
            "says how far each motor turns"
        )
    try:
        content = json.loads(motors.read_text())
    except (OSError, ValueError) as error:
        raise KinematicsError(f"cannot read {motors}: {error}") from None
    if not isinstance(content, dict):
        raise KinematicsError(f"{motors} must map motors to their calibration, got {type(content).__name__}")
    missing = [name for name in joints if name not in content]
    if missing:
        raise KinematicsError(f"{motors} lacks {', '.join(missing)}; it has {', '.join(content)}")
    scales = []
    for name in joints:
        try:
            lowest, highest, mode = (float(content[name][key]) for key in ("range_min", "range_max", "drive_mode"))
        except (KeyError, TypeError, ValueError):
            raise KinematicsError(f"{motors}: {name} needs range_min, range_max and drive_mode") from None
        if not 0 <= lowest < highest <= STEPS:
            raise KinematicsError(f"{motors}: {name} has a range from {lowest:g} to {highest:g}, of 0 to {STEPS}")
        if mode and name not in signs:
            raise KinematicsError(f"{motors}: {name} has a drive_mode: say by signs whether it turns as the model's")
        scales.append((highest - lowest) / 2 / FULL * 2 * np.pi / STEPS)
    return np.array(scales)


def check_positions(arm: Arm, values: NDArray[np.floating], units: JointUnits) -> None:
    """Raise a KinematicsError if a recording's joints contradict their units or the limits of the model.

    Args:
        arm: the arm.
        values: (N, V) the robot's states of all frames.
        units: of its angles.
    """
    if not np.isfinite(values).all():
        raise KinematicsError("the joints have values that are not finite")
    positions = arm.positions(values)
    turning = arm.model.is_revolute
    numbers = (positions - arm.offset) / arm.scale
    if units == "degrees" and len(values) > 1 and np.abs(numbers[:, turning]).max() <= SMALL:
        raise KinematicsError(
            f"no joint exceeds {np.abs(numbers[:, turning]).max():.3g} in all {len(values)} frames, as degrees next to "
            "nothing: they look like radians"
        )
    excess = np.maximum(arm.model.lower - positions, positions - arm.model.upper)
    outside = excess > np.where(turning, BEYOND, 0.01)
    wrong = outside.mean(axis=0) > FEW
    if wrong.any():
        each = [
            f"{arm.joints[index]} goes from {numbers[:, index].min():.4g} to {numbers[:, index].max():.4g}, "
            f"in the model {_shown(positions[:, index].min(), turning[index])} to "
            f"{_shown(positions[:, index].max(), turning[index])}, whose limits are "
            f"{_shown(arm.model.lower[index], turning[index])} and {_shown(arm.model.upper[index], turning[index])}"
            for index in np.flatnonzero(wrong)
        ]
        hint = {
            "radians": "degrees taken for radians?",
            "degrees": "are they normalized, or is a sign or an offset wrong?",
            "normalized": "is it this arm's calibration file, or are they degrees?",
        }
        raise KinematicsError(f"{'; '.join(each)}: {hint[units]}")


def check_present(arm: Arm, positions: Array) -> None:
    """Raise a KinematicsError if a robot's positions (N, J) are far outside the model's limits, or not finite."""
    excess = np.maximum(arm.model.lower - positions, positions - arm.model.upper)
    wrong = ~(excess <= np.where(arm.model.is_revolute, 2 * BEYOND, 0.02)).all(axis=0)
    if wrong.any():
        each = [
            f"{arm.joints[index]} at {_shown(positions[:, index].max(), arm.model.is_revolute[index])}"
            for index in np.flatnonzero(wrong)
        ]
        raise KinematicsError(
            f"the robot gives {', '.join(each)} of the model, far outside its limits: its joints must have the order "
            f"{', '.join(arm.state_names)} and the units of the recording"
        )


def _shown(position: float, turns: bool) -> str:
    return f"{np.rad2deg(position):.0f} degrees" if turns else f"{position:.3f} m"
