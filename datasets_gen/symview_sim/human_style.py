"""Demonstrations like a person's: a style drawn for each episode, and the motion of a hand that has it.

A hand has inertia, so it gathers speed, goes a little past its goal and returns. Its path is bent, its pace varies, it
pauses, aims slightly beside a goal at first, and now and then makes a mistake that it corrects. All functions are pure.
A rotation or reflection of the scene maps a style to one that is as probable (`Style`), and its actions to the other's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_symview.geometry.camera import Array
from symview_sim.control import CLOSED, OPEN, Control

WRONG_PLACE, EARLY_CLOSE = "wrong_place", "early_close"
MISTAKE_PROBABILITY = 0.3
ABOVE_OBJECTS = 0.1  # metres above the table: higher than the objects, so that a wrong aim touches none
AIMED = 0.01  # metres from the wrong place at which the hand notices
NOTICED = 3.0  # seconds after which it notices anyway: the place may be out of reach
STILL, PLACED, TURNED = 0.03, 0.006, 0.1  # m/s, metres, rad: slow and near enough to close or open the fingers
EARLY = 0.045  # metres above an object at which the fingers close too early
YAW_PACE = 15.0  # rad/s for each m/s of the hand's pace
CLOSING, OPENING = 0.6, 0.5  # seconds of an early closing and of the opening after it
FINGER_RATE = 3.0  # apertures per second
NEVER = -math.inf


@dataclass(frozen=True)
class Style:
    """How one episode is demonstrated.

    A planar transform of the scene transforms `aim`; a reflection also negates `bend` and may exchange ways. It changes
    nothing else.
    """

    way: int
    """Which of the task's ways is taken (`Task.ways`)."""
    bend: float
    """Angle between the path above the objects and the straight line, rad; positive begins to the left of it."""
    pace: float
    """Mean speed, metres per second."""
    swing: tuple[float, float, float]
    """Variation of the pace: relative amplitude, period in seconds, phase in rad."""
    reaction: float
    """Speed per remaining distance, 1/s."""
    inertia: float
    """Time in which the hand changes its velocity, seconds."""
    pauses: tuple[tuple[float, float], ...]
    """Start and duration of each pause, seconds."""
    aim: tuple[float, float]
    """Displacement (2,) of the place aimed at first, world frame, metres; it is corrected on arrival."""
    mistake: str
    """`none`, `wrong_place` (a first aim beside the goal by centimetres), or `early_close` (the fingers close above the
    object, and open again)."""


@dataclass(frozen=True)
class Hand:
    """What a hand remembers of the episode."""

    velocity: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Metres per second and rad per second."""
    aperture: float = OPEN
    target: float = OPEN
    """Aperture that the fingers move to; they do not turn back half way."""
    has_aimed: bool = False
    """Whether the first aim is corrected."""
    closed_early: float = NEVER
    """Time at which the fingers closed too early, seconds."""
    rests_until: float = NEVER
    """End of the pause after a wrong aim, seconds."""


def draw_style(rng: np.random.Generator, ways: int, mistakes: Sequence[str]) -> Style:
    """Draw the style of an episode.

    Args:
        rng: source of randomness.
        ways: number of ways to solve the task; all are equally probable.
        mistakes: those that the task allows; 3 in 10 episodes have one.
    """
    mistake = str(rng.choice(mistakes)) if mistakes and rng.random() < MISTAKE_PROBABILITY else "none"
    angle = rng.uniform(0, 2 * np.pi)
    distance = rng.uniform(0.03, 0.05) if mistake == WRONG_PLACE else rng.uniform(0.004, 0.012)
    starts = np.cumsum(rng.uniform(0.8, 4.0, size=rng.integers(3)))
    return Style(
        way=int(rng.integers(ways)),
        bend=float(rng.choice([-1.0, 1.0]) * np.radians(rng.uniform(15, 40))),
        pace=float(rng.uniform(0.08, 0.14)),
        swing=(float(rng.uniform(0.1, 0.35)), float(rng.uniform(1.5, 4.0)), float(rng.uniform(0, 2 * np.pi))),
        reaction=float(rng.uniform(3.5, 5.5)),
        inertia=float(rng.uniform(0.15, 0.28)),
        pauses=tuple((float(start), float(rng.uniform(0.4, 1.0))) for start in starts),
        aim=(float(distance * np.cos(angle)), float(distance * np.sin(angle))),
        mistake=mistake,
    )


def human_action(
    style: Style, hand: Hand, seconds: float, intent: Array, height: float, control: Control
) -> tuple[Array, Hand]:
    """Return the action (5,) of a hand, and what it remembers afterwards.

    Args:
        style: of the episode.
        hand: what the hand remembers; `Hand()` at the start of an episode.
        seconds: time since the start of the episode.
        intent: (5,) what the expert does: the remaining dx, dy, dz, metres, dyaw, rad, and the aperture in [0, 1].
        height: of the gripper above the table, metres.
        control: the rate and the limits of the actions.
    """
    aperture = float(intent[4])
    hand = _notice(style, hand, seconds, intent, height)
    path = intent[:2] if hand.has_aimed else intent[:2] + style.aim
    path = _turned(path, style.bend * _share(height, 0.05, 0.13) * _share(_length(path), 0.0, 0.06))
    since = seconds - hand.closed_early
    goal: Array = np.zeros(4)
    if since < CLOSING + OPENING:
        aperture = CLOSED if since < CLOSING else OPEN
    elif seconds < hand.rests_until or any(start <= seconds < start + length for start, length in style.pauses):
        aperture = hand.aperture
    else:
        goal = _velocity(style, seconds, np.concatenate([path, intent[2:4]]))
        if control.arrives(intent[:4]) and not _is_placed(hand, intent):
            aperture = hand.aperture
    target = aperture if hand.aperture == hand.target else hand.target
    kept = math.exp(-1 / (control.actions_per_second * style.inertia))
    velocity = kept * np.asarray(hand.velocity) + (1 - kept) * goal
    done = _within(velocity / control.actions_per_second, control.limits)
    change = FINGER_RATE / control.actions_per_second
    aperture = min(max(target, hand.aperture - change), hand.aperture + change)
    x, y, z, yaw = done * control.actions_per_second
    return np.append(done, aperture), replace(hand, velocity=(x, y, z, yaw), aperture=aperture, target=target)


def _notice(style: Style, hand: Hand, seconds: float, intent: Array, height: float) -> Hand:
    """Return the memory of a hand that may have reached the place it aims at, or an object."""
    is_there = height < ABOVE_OBJECTS or _length(intent[:2] + style.aim) < AIMED or seconds > NOTICED
    if not hand.has_aimed and is_there:
        rest = 0.5 if style.mistake == WRONG_PLACE else 0.0
        hand = replace(hand, has_aimed=True, rests_until=seconds + rest)
    is_over = height < ABOVE_OBJECTS and _length(intent[:2]) < 0.02 and intent[2] > -EARLY
    may_close = style.mistake == EARLY_CLOSE and hand.closed_early == NEVER
    if may_close and is_over and intent[4] == hand.aperture == OPEN:
        hand = replace(hand, closed_early=seconds)
    return hand


def _velocity(style: Style, seconds: float, motion: Array) -> Array:
    """Return the velocity (4,) at which a hand without inertia would make a motion (4,): slower near its end."""
    amplitude, period, phase = style.swing
    pace = style.pace * (1 + amplitude * math.sin(2 * np.pi * seconds / period + phase))
    velocity = motion * style.reaction
    velocity[:3] *= min(1.0, pace / max(_length(velocity[:3]), 1e-9))
    velocity[3] = np.clip(velocity[3], -YAW_PACE * pace, YAW_PACE * pace)
    return velocity


def _is_placed(hand: Hand, intent: Array) -> bool:
    """Whether the hand is near enough to its goal, and slow enough, to close or open the fingers."""
    is_near = _length(intent[:3]) < PLACED and abs(intent[3]) < TURNED
    return is_near and _length(np.asarray(hand.velocity[:3])) < STILL


def _within(motion: Array, limits: Array) -> Array:
    """Shorten the translation of a motion (4,) to the limits, in its direction, and the rotation."""
    longest = np.abs(motion[:3] / limits[:3]).max()
    return np.append(motion[:3] / max(longest, 1.0), np.clip(motion[3], -limits[3], limits[3]))


def _turned(vector: Array, angle: float) -> Array:
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1]])


def _share(value: float, low: float, high: float) -> float:
    """Return 0 below `low`, 1 above `high`, and a line between them."""
    return min(max((value - low) / (high - low), 0.0), 1.0)


def _length(vector: Array) -> float:
    return float(np.linalg.norm(vector))
