"""Feature names of a dataset, shared by the simulator, the views and the policies."""

STATE = "observation.state"
ACTION = "action"
STATE_NAMES = ["x", "y", "z", "yaw", "aperture"]
ACTION_NAMES = ["dx", "dy", "dz", "dyaw", "aperture"]


def rgb(camera: str) -> str:
    """uint8 (H, W, 3) colour image of `camera`."""
    return f"observation.images.{camera}"


def depth(camera: str) -> str:
    """float32 (H, W, 1) depth along the optical axis, metres, 0 = invalid."""
    return f"observation.images.{camera}_depth"


def segmentation(camera: str) -> str:
    """uint8 (H, W, 3) segmentation label, repeated in the three channels: 0 table, 1 robot, 2 and up objects."""
    return f"observation.images.{camera}_segmentation"


def intrinsics(camera: str) -> str:
    """float32 (9,) 3 x 3 intrinsic matrix K in pixels, row-major."""
    return f"observation.camera.{camera}.intrinsics"


def world_from_cam(camera: str) -> str:
    """float32 (16,) 4 x 4 camera-to-world transform, row-major, metres."""
    return f"observation.camera.{camera}.world_from_cam"


def view(camera: str, output: str) -> str:
    """Output of a view rendered from `camera`; `output` is, for example, `reproj` or `reproj_height`."""
    return f"observation.images.{camera}_{output}"
