"""What a policy reads from a dataset: inputs, view options, workspace, and the calibration of a fixed camera."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs.types import FeatureType, PolicyFeature

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.symmetry.representations import types_of
from lerobot_symview import keys
from lerobot_symview.calibration.file import (
    Calibration,
    check_origin,
    parse_calibration,
    parse_workspace,
    plain_calibration,
)
from lerobot_symview.datasets.features import image_size
from lerobot_symview.datasets.metadata import ADDED_VIEWS, read_settings
from lerobot_symview.errors import CalibrationError, OptionError
from lerobot_symview.geometry.camera import Camera, stored_camera
from lerobot_symview.geometry.gripper_state import missing_of
from lerobot_symview.geometry.state_reader import StateReader, is_end_effector
from lerobot_symview.kinematics.arm import INCREMENT
from lerobot_symview.views import View, ViewSpec

Features = dict[str, dict[str, Any]]

logger = logging.getLogger(__name__)


def read_features(config: SymviewConfig, features: Features) -> None:
    """Set a configuration's inputs, outputs, view options and workspace from a dataset's features.

    LeRobot accepts no visual feature at evaluation that was not declared in training, so the camera's raw images are
    declared even where training reads only views made from them.

    A checkpoint's camera may have another name in the dataset, which LeRobot allows with `--rename_map` only.

    Raises:
        ValueError: if the dataset lacks what the policy needs, or contradicts its declarations.
    """
    _check_vectors(config, features)
    _read_arm(config, features)
    features = _own_names(config, features)
    _read_view(config, features)
    has_raw = all(key in features for key in config.all_raw_keys)
    if not has_raw and config.color_key not in features:
        raise ValueError(
            f"--policy.view={config.view.name} needs {config.all_raw_keys} or {config.color_key!r}; "
            f"the dataset has {sorted(key for key in features if 'images' in key)}: "
            "for the view of another camera, give its name by --policy.camera"
        )
    if config.camera_augmentation and not has_raw:
        raise ValueError(
            f"--policy.camera_augmentation makes views anew from {config.all_raw_keys}, which the dataset lacks: keep "
            "the camera's images when adding views"
        )
    if config.remembers and config.color_key not in features:
        raise ValueError(
            f"--policy.view={config.view.name} with memory=true is made from the frames of an episode in order, which "
            f"training does not read: add it to the dataset, by symview-add-views --{config.view.name}.memory=true"
        )
    _check_size(config, features)
    _check_alignment(config, features)
    visuals = config.all_raw_keys
    if not has_raw:
        visuals += [key for key, feature in features.items() if feature["dtype"] in ("image", "video")]
    config.input_features = {
        keys.STATE: PolicyFeature(FeatureType.STATE, tuple(features[keys.STATE]["shape"])),
        **{key: PolicyFeature(FeatureType.VISUAL, _channel_first(features, key)) for key in visuals},
    }
    config.output_features = {keys.ACTION: PolicyFeature(FeatureType.ACTION, tuple(features[keys.ACTION]["shape"]))}


def name_inputs(config: SymviewConfig) -> None:
    """Name the inputs of a checkpoint by its camera, which a flag may have changed: LeRobot compares them with data."""
    if config.input_features:
        config.input_features = config.own_names(config.input_features)
        _name_state(config)


def _check_vectors(config: SymviewConfig, features: Features) -> None:
    """Check the declared types of state and action; where they are the default, read them from the dataset's names."""
    for kind, key in (("state", keys.STATE), ("action", keys.ACTION)):
        if key not in features:
            raise ValueError(f"the dataset lacks {key!r}, which the policy needs; it has {sorted(features)}")
        names = features[key].get("names")
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            names = None
        size = int(features[key]["shape"][0])
        recorded = names or []
        if kind == "state" and is_end_effector(recorded):
            names = StateReader(tuple(recorded)).read_names
            size = len(names)
        types = types_of(names or ())
        if types and getattr(config, f"{kind}_symmetry") == keys.STATE_NAMES:
            setattr(config, f"{kind}_symmetry", types)
        representation = config.states if kind == "state" else config.actions
        representation.check(size, key, names if config.group != "C1" else None)
        if kind == "state":
            config.state_names = recorded if is_end_effector(recorded) else []
    _name_state(config)
    config.check()  # options that depend on the types


def _read_arm(config: SymviewConfig, features: Features) -> None:
    """Take over the arm of a dataset whose joints were converted to increments of the gripper's pose."""
    meaning = (features[keys.STATE].get("info") or {}).get("symview", {})
    if "arm" in meaning and features[keys.ACTION].get("names") == list(INCREMENT):
        config.arm = dict(meaning["arm"])
        config.check()


def _name_state(config: SymviewConfig) -> None:
    """Name the dimensions of a state whose positions count from elsewhere by their types.

    Raises:
        ValueError: if no dimensions are declared as positions.
    """
    if config.state_names or config.state_origin in (None, "workspace"):
        return
    missing = missing_of(config.state_symmetry)
    if missing:
        raise ValueError(
            f"--policy.state_origin={config.state_origin} is of the gripper's position; --policy.state_symmetry="
            f"{config.state_symmetry} lacks {missing}"
        )
    config.state_names = list(config.state_symmetry)


def _own_names(config: SymviewConfig, features: Features) -> Features:
    """Return the features with the names of the policy's camera, where the dataset's camera has another name."""
    others = config.substitutes(features)
    if not others:
        return features
    flags = " or ".join(f"--policy.camera={other}" for other in others)
    if len(others) > 1 or config.pretrained_path is None:  # LeRobot renames features for checkpoints only
        raise ValueError(f"the dataset has no images of the camera {config.seen_camera!r}: use {flags}")
    logger.info(
        "the dataset has no images of the camera %r: those of %r take their place, if --rename_map renames them; %s "
        "trains under the dataset's name",
        config.seen_camera,
        *others,
        flags,
    )
    return config.own_names(features)


def _read_view(config: SymviewConfig, features: Features) -> None:
    """Take over how the dataset's view was made; else the workspace of the camera's image."""
    stored = features.get(config.color_key, {}).get("info") or {}
    if config.is_computed and "symview" in stored:
        try:
            config.view = ViewSpec(config.view.name, stored["symview"]["options"])
            config.workspace = dict(stored["symview"]["workspace"])
            config.make_view()
            parse_workspace(config.workspace)
        except (KeyError, TypeError, ValueError, OptionError) as error:
            raise ValueError(f"the dataset does not say how {config.color_key} was made: {error}") from None
    else:
        raw = features.get(keys.rgb(config.seen_camera), {}).get("info") or {}
        config.workspace = dict(raw.get("symview", {}).get("workspace", config.workspace))
        if config.is_computed and config.missing_of_gripper:
            changed = _changed_options(config.make_view(), config.make_view().without_gripper())
            config.view = ViewSpec(config.view.name, config.view.options | changed)
            if changed:
                logger.info(
                    "the state does not say where the gripper is (it lacks %s): the view %s is made with %s",
                    config.missing_of_gripper,
                    config.view.name,
                    ", ".join(f"{name}={value}" for name, value in changed.items()),
                )


def read_calibration(config: SymviewConfig) -> None:
    """Set a configuration's calibration to that of the cameras that never moved in the training dataset.

    It is for observations without calibration, such as a real robot's. If the policy's camera moved, or the dataset
    lacks its calibration, the configuration is unchanged, unless its calibration is that of another camera.

    Raises:
        CalibrationError: if the calibration in the dataset is invalid.
    """
    meta = getattr(config, "_runtime_dataset_meta", None)  # set by LeRobot before it makes the policy
    if meta is not None:
        _read_origin(config, meta)
    given = _calibration_file(meta) if meta is not None else None
    if given is None and config.calibration:
        given = parse_calibration(config.calibration)
    if given is not None and given.origin_height:
        config.origin_height = given.origin_height
    if given is not None:
        check_origin(given, config.state_origin, config.state_names or config.state_symmetry)
    if meta is not None and (config.uses_calibration or config.check_camera):
        name = next(iter(config.substitutes(meta.features)), config.camera)
        names = {config.camera: name} | {other: other for other in config.merged_cameras}  # own -> the dataset's
        found = {own: _fixed_camera(meta, recorded) for own, recorded in names.items()}
        cameras = {own: camera for own, camera in found.items() if camera is not None}
        if config.camera in cameras:
            file = _calibration_file(meta)
            units = (
                {own: file.depth_units[names[own]] for own in cameras if names[own] in file.depth_units} if file else {}
            )
            config.calibration = plain_calibration(Calibration(cameras, depth_units=units))
        elif name != config.camera:
            config.calibration = {}


def _read_origin(config: SymviewConfig, meta: Any) -> None:
    """Take over what positions count from, as `symview-add-views` was told.

    Raises:
        ValueError: if the flag says something else.
    """
    stored = read_settings(Path(meta.root), ADDED_VIEWS).get("state_origin")
    if stored is None or stored == config.state_origin:
        return
    if config.state_origin is not None:
        raise ValueError(
            f"--policy.state_origin={config.state_origin}: the dataset's views were made with --state_origin={stored}"
        )
    config.state_origin = stored
    _name_state(config)


def _fixed_camera(meta: Any, name: str) -> Camera | None:
    """Return the camera whose calibration is the same in all frames; None if there is none of known image size."""
    # The statistics of the columns tell: LeRobot's tools keep them in every dataset that they write.
    columns = keys.calibration(name, meta.features)
    stats = meta.stats or {}
    if not all(key in stats and np.array_equal(stats[key]["min"], stats[key]["max"]) for key in columns):
        return None
    size = _image_size(meta, name)
    if size is None:
        return None
    stored = {keys.parameter(key): stats[key]["min"] for key in columns}
    try:
        return stored_camera(height=size[0], width=size[1], **stored)
    except CalibrationError as error:
        raise CalibrationError(f"the dataset's calibration of camera {name!r}: {error}") from None


def _image_size(meta: Any, camera: str) -> tuple[int, int] | None:
    """Return the rows and columns of a camera's images, also where `symview-add-views` left them out."""
    size = image_size(meta.features, keys.rgb(camera))
    if size is not None:
        return size
    left_out = read_settings(Path(meta.root), ADDED_VIEWS).get("image_sizes", {}).get(keys.rgb(camera))
    if left_out:
        return (int(left_out[0]), int(left_out[1]))
    recorded = _calibration_file(meta)
    in_file = recorded.cameras.get(camera) if recorded else None
    return (in_file.height, in_file.width) if in_file else None


def _calibration_file(meta: Any) -> Calibration | None:
    """Return the content of the calibration file that `symview-add-views` was given; None if there was none."""
    content = read_settings(Path(meta.root), ADDED_VIEWS).get("calibration")
    return parse_calibration(content) if content else None


def _changed_options(view: View, other: View) -> dict[str, Any]:
    """Return the options in which `other` differs from `view`."""
    return {name: getattr(other, name) for name in vars(other) if getattr(other, name) != getattr(view, name)}


def _check_size(config: SymviewConfig, features: Features) -> None:
    is_recorded = config.color_key in features
    size = min(features[config.color_key]["shape"][:2]) if is_recorded else config.make_view().size
    if size < config.crop_size and not config.sees_points:
        raise ValueError(
            f"--policy.crop_size={config.crop_size} is larger than the {size} px of the shorter side of "
            f"{config.color_key!r}: lower it or make larger views"
        )


def _check_alignment(config: SymviewConfig, features: Features) -> None:
    key = keys.depth(config.seen_camera)
    if config.is_computed or key not in config.all_raw_keys or key not in features:
        return  # views register depth
    sensor = keys.depth_intrinsics(config.seen_camera)
    size, color_size = (image_size(features, name) for name in (key, config.color_key))
    reasons = [f"the dataset has {sensor}"] if sensor in features else []
    if "depth_sensor" in config.calibration.get("cameras", {}).get(config.seen_camera, {}):
        reasons.append("--policy.calibration has a depth_sensor")
    if size != color_size:
        reasons.append(f"it has {size} pixels, colour {color_size}")
    if reasons:
        raise ValueError(
            f"--policy.method={config.method} reads {key}, which is not aligned with colour, since "
            f"{' and '.join(reasons)}: choose a method with a view, such as reproj_equi, or align depth when recording"
        )


def _channel_first(features: Features, key: str) -> tuple[int, ...]:
    """Return the shape (C, H, W) of an image feature; (C, 0, 0) for a raw image that the dataset left out."""
    if key not in features:
        return (1 if key.endswith("_depth") else 3, 0, 0)
    height, width, channels = features[key]["shape"]
    return (channels, height, width)
