"""Feature names of a dataset, shared by the simulator, the views and the policies."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

STATE = "observation.state"
ACTION = "action"
JOINTS, JOINT_TARGETS = "observation.joints", "observation.joint_targets"  # kept beside a converted state and action
STATE_NAMES = ["x", "y", "z", "yaw", "aperture"]
ACTION_NAMES = ["dx", "dy", "dz", "dyaw", "aperture"]
IMAGES, CALIBRATIONS = "observation.images.", "observation.camera."
ORACLE = "top"  # the simulator's camera straight above the table
WRIST = "wrist"  # the simulator's camera on the gripper


def rgb(camera: str) -> str:
    """uint8 (H, W, 3) colour image of `camera`."""
    return f"{IMAGES}{camera}"


def depth(camera: str) -> str:
    """float32 (H, W, 1) depth along the optical axis, metres, 0 = invalid."""
    return f"{IMAGES}{camera}_depth"


def segmentation(camera: str) -> str:
    """uint8 (H, W, 3) segmentation label, repeated in the three channels: 0 table, 1 robot, 2 and up objects."""
    return f"{IMAGES}{camera}_segmentation"


def intrinsics(camera: str) -> str:
    """float32 (9,) 3 x 3 intrinsic matrix K in pixels, row-major."""
    return f"{CALIBRATIONS}{camera}.intrinsics"


def world_from_cam(camera: str) -> str:
    """float32 (16,) 4 x 4 camera-to-world transform, row-major, metres."""
    return f"{CALIBRATIONS}{camera}.world_from_cam"


def distortion(camera: str) -> str:
    """float32 (9,) model and coefficients of the lens, as `Lens.stored` returns; absent for pinhole cameras."""
    return f"{CALIBRATIONS}{camera}.distortion"


def depth_intrinsics(camera: str) -> str:
    """float32 (9,) K of the depth sensor in pixels, row-major; absent where depth is aligned with colour."""
    return f"{CALIBRATIONS}{camera}.depth_intrinsics"


def color_from_depth(camera: str) -> str:
    """float32 (16,) depth-to-colour transform, row-major, metres; absent where depth is aligned with colour."""
    return f"{CALIBRATIONS}{camera}.color_from_depth"


def calibration(camera: str, names: Collection[str] | None = None) -> list[str]:
    """Features of the calibration of `camera`: intrinsics and pose, then those that only some cameras have.

    Their last parts are the parameters of `stored_camera`.

    Args:
        camera: name of the camera.
        names: the features of an observation or dataset; by default it has all.
    """
    some = [distortion(camera), depth_intrinsics(camera), color_from_depth(camera)]
    return [intrinsics(camera), world_from_cam(camera), *(key for key in some if names is None or key in names)]


def parameter(key: str) -> str:
    """Return the last part of the key of a calibration's feature, such as `intrinsics`."""
    return key.rpartition(".")[2]


def view(camera: str, output: str) -> str:
    """Output of a view rendered from `camera`; `output` is, for example, `reproj` or `reproj_height`."""
    return f"{IMAGES}{camera}_{output}"


def of_camera(key: str, camera: str, other: str) -> str:
    """Return the feature of camera `other` that corresponds to the feature `key` of `camera`."""
    prefix = CALIBRATIONS if key.startswith(CALIBRATIONS) else IMAGES
    return prefix + other + key.removeprefix(prefix + camera)


def substitutes(names: Collection[str], camera: str, *alternatives: list[str]) -> list[str]:
    """Return the cameras that can take the place of `camera`; one if it is clear, none if none is needed.

    LeRobot's `--rename_map` renames single features: a camera's image, but not its depth, calibration and views. The
    substitute is thus the camera with whose features those of `camera` are complete, but not without them: of each
    pair, exactly one is there. The simulator's oracle takes no other camera's place.

    Args:
        names: the features of an observation or dataset.
        camera: the camera whose features are needed.
        alternatives: lists of features of `camera`, any of which suffices.
    """
    if any(set(needed) <= set(names) for needed in alternatives):
        return []
    found: set[str] = set()
    for needed in alternatives:
        candidates = [
            other
            for other in _cameras_with(names, max((key for key in needed if key not in names), key=len), camera)
            if all((key in names) != (of_camera(key, camera, other) in names) for key in needed)
        ]
        if len(candidates) == 1:
            return candidates
        found.update(candidates)
    return sorted(found)


def _cameras_with(names: Collection[str], key: str, camera: str) -> list[str]:
    """Return the other cameras that have the feature that corresponds to `key` of `camera`."""
    prefix, suffix = of_camera(key, camera, "\0").split("\0")
    others = {
        name[len(prefix) : len(name) - len(suffix)]
        for name in names
        if name.startswith(prefix) and name.endswith(suffix) and len(name) > len(prefix) + len(suffix)
    }
    views = {other for other in others if any(other.startswith(f"{longer}_") for longer in others)}
    return sorted(others - views - {camera, ORACLE})


def as_camera[Value](features: Mapping[str, Value], camera: str, other: str, keys: Iterable[str]) -> dict[str, Value]:
    """Return the features with those of camera `other` under the names `keys` of `camera`, where these are missing."""
    moved = {of_camera(key, camera, other): key for key in keys if key not in features}
    return {moved.get(key, key): value for key, value in features.items()}
