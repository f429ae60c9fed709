"""What `symview-preview` says about the declared types: how far the demonstrations contradict them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lerobot_policy_symview.symmetry.declaration_check import LEAST_EPISODES, Consistency, Motion, consistency, motion
from lerobot_policy_symview.symmetry.groups import PlanarGroup, make_group
from lerobot_policy_symview.symmetry.representations import VectorRepresentation, types_of
from lerobot_policy_symview.symmetry.trajectories import MOVING, ActionMode
from lerobot_symview import keys
from lerobot_symview.datasets.features import names_of
from lerobot_symview.datasets.frame_reader import FrameReader
from lerobot_symview.datasets.source import EpisodeTables, SourceDataset, vectors
from lerobot_symview.errors import CalibrationError, SymviewError
from lerobot_symview.geometry.state_reader import StateReader
from symview_eval.declaration_words import described, kind_of, measured, problems
from symview_eval.gripper_path import gripper_points
from symview_eval.motion_check import MotionScores, motion_scores

logger = logging.getLogger(__name__)

GROUP = "D4"
MOST_EPISODES, MOST_SEEN, SEEN_FRAMES = 100, 12, 40  # episodes of numbers, episodes of images, and frames of each
WINDOW = 0.3  # seconds over which motion is measured
MARGIN = 0.1  # fraction of the motion that targets must explain more than increments to be taken for them


@dataclass
class DeclarationReport:
    """What was measured, and what contradicts the declaration; sentences."""

    facts: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def check_declaration(
    source: SourceDataset,
    reader: FrameReader | None,
    state_types: Sequence[str] | None = None,
    action_types: Sequence[str] | None = None,
) -> DeclarationReport:
    """Compare the declared types with the demonstrations, by their numbers, and by their images where there are some.

    Args:
        source: the dataset.
        reader: of a camera's frames; None to leave out the images.
        state_types: of the state; by default those that its names are.
        action_types: of the action; by default those that its names are.

    Raises:
        ValueError: if the types do not fit the dataset.
    """
    report, group = DeclarationReport(), make_group(GROUP)
    states = _state_reader(source, reader)
    action_names = names_of(source.features, keys.ACTION)
    state_types, action_types = state_types or types_of(states.read_names), action_types or types_of(action_names)
    missing = [key for key in (keys.STATE, keys.ACTION) if key not in source.features]
    if missing:
        report.facts.append(f"not checked: the dataset lacks {', '.join(missing)}")
    elif state_types is None or action_types is None:
        report.facts.append(
            "not checked: the names of states and actions are no types; declare them by --state_symmetry and "
            "--action_symmetry"
        )
    else:
        of_state = VectorRepresentation(tuple(state_types), "--state_symmetry")
        of_action = VectorRepresentation(tuple(action_types), "--action_symmetry")
        of_state.check(len(states.read_names) or source.features[keys.STATE]["shape"][0], keys.STATE, states.read_names)
        of_action.check(source.features[keys.ACTION]["shape"][0], keys.ACTION, action_names)
        if len(source.episodes) < LEAST_EPISODES:
            report.facts.append(f"not checked: {len(source.episodes)} episodes, expected at least {LEAST_EPISODES}")
            return report
        _check_numbers(report, source, states, of_state, of_action, group)
    if reader is not None:
        try:
            _check_images(report, reader, group)
        except SymviewError as error:
            report.facts.append(f"the images are not checked: {error}")
    return report


def _check_numbers(
    report: DeclarationReport,
    source: SourceDataset,
    reader: StateReader,
    states: VectorRepresentation,
    actions: VectorRepresentation,
    group: PlanarGroup,
) -> None:
    """Report how the state's motion follows from the actions."""
    count = len(source.episodes)
    episodes = np.unique(np.linspace(0, count - 1, min(count, MOST_EPISODES)).round().astype(int)).tolist()
    recorded = []
    for episode in episodes:
        vectors_of_episode = _vectors(source, episode)
        if all(np.isfinite(values).all() for values in vectors_of_episode):
            recorded.append(vectors_of_episode)
        else:
            report.warnings.append(f"a state or an action of episode {episode} is not finite: the check leaves it out")
    if len(recorded) < LEAST_EPISODES:
        report.facts.append(f"not checked: {len(recorded)} episodes have finite states and actions")
        return
    values = [reader.read(state) for state, _ in recorded], [action for _, action in recorded]
    longest = max(map(len, values[0]))
    window = int(np.clip(round(WINDOW * source.info["fps"]), 1, max(1, longest // 4)))
    found: dict[ActionMode, list[Consistency]] = {}
    for mode in ("delta", "absolute"):
        moved: Motion = motion(*values, states, actions, mode, window)
        if len(moved.inputs) < LEAST_EPISODES:
            report.facts.append(f"not checked: {len(moved.inputs)} episodes are long enough")
            return
        found[mode] = consistency(moved, group)
    are_targets = _explained(found["absolute"]) > _explained(found["delta"]) + MARGIN
    results = found["absolute" if are_targets else "delta"]
    if are_targets:
        names = names_of(source.features, keys.ACTION)
        say = report.warnings if any(name.startswith("d") for name in names) else report.facts
        say.append(
            "the actions are targets of the position, not increments: train with --policy.action_mode=absolute, or "
            "record increments"
        )
    report.facts += [measured(result, group) for result in results]
    report.warnings += [text for result in results for text in problems(result, results, states, actions, group)]


def _explained(results: list[Consistency]) -> float:
    """Return the mean fraction of the gripper's motion that actions explain."""
    fractions = [np.clip(result.explained, 0, 1) for result in results if kind_of(result) in MOVING]
    return float(np.mean(fractions)) if fractions else 0.0


def _check_images(report: DeclarationReport, reader: FrameReader, group: PlanarGroup) -> None:
    """Report whether the images change where the gripper is."""
    reader = replace(reader, views=[])  # without depth
    count = len(reader.dataset.episodes)
    scores = []
    for episode in np.unique(np.linspace(0, count - 1, min(count, MOST_SEEN)).round().astype(int)).tolist():
        points = gripper_points(reader, episode)
        if points is None:
            return
        shown = np.unique(np.linspace(0, len(points) - 1, SEEN_FRAMES).round().astype(int))
        table = EpisodeTables(reader.dataset, reader.dataset.data_file(episode), reader.columns()).read(episode)
        frames = [frame for index in shown for frame in reader.frames(episode, table.take([index]))]  # of a video too
        camera = frames[0].camera
        if any((frame.camera.world_from_cam != camera.world_from_cam).any() for frame in frames):
            continue
        images = np.stack([frame.rgb for frame in frames])
        found = motion_scores(images, points[shown], camera, reader.workspace, group) if len(shown) > 1 else None
        scores += [] if found is None else [found]
    if len(scores) < LEAST_EPISODES:
        return
    result = MotionScores(np.array(scores), group)
    best, means = result.best(), result.means
    if best is None:
        report.facts.append("the images do not say whether the gripper is where the state says")
        return
    second, other = max((score, index) for index, score in enumerate(means) if index != best)
    place = (
        "the state says that the gripper is" if best == 0 else f"it would be if the state were {described(group, best)}"
    )
    report.facts.append(
        f"the images of {len(scores)} episodes change where {place}: {means[best]:.1f} "
        f"standard deviations, {second:.1f} where it would be {described(group, other)}"
    )
    if best:
        report.warnings.append(
            f"what moves in the images of {reader.camera} is where the gripper would be if the state were "
            f"{described(group, best)}: check the signs and the order of the state's x and y, the yaw of robot_base in "
            "the calibration, and the camera's pose"
        )


def _vectors(source: SourceDataset, episode: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return an episode's states (T, S) and actions (T, A)."""
    columns = [keys.STATE, keys.ACTION]
    table = EpisodeTables(source, source.data_file(episode), columns).read(episode)
    state, action = (vectors(table, column).astype(np.float64) for column in columns)
    return state, action


def _state_reader(source: SourceDataset, reader: FrameReader | None) -> StateReader:
    """Return what reads states; where positions count from does not matter to their motion."""
    try:
        if reader is not None:
            return reader.state_reader
    except CalibrationError as error:
        logger.warning("the calibration does not say where the state's positions count from: %s", error)
    return StateReader(tuple(names_of(source.features, keys.STATE)))
