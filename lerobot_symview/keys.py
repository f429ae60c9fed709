"""Names of a dataset's features: one place, so that the simulator, the views and the policies agree."""

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
    """uint8 (H, W, 3) label of what a pixel shows, the same in each channel: 0 table, 1 robot, 2 and up objects."""
    return f"observation.images.{camera}_segmentation"


def intrinsics(camera: str) -> str:
    """float32 (9,) K in pixels, row-major."""
    return f"observation.camera.{camera}.intrinsics"


def world_from_cam(camera: str) -> str:
    """float32 (16,) pose, row-major, metres."""
    return f"observation.camera.{camera}.world_from_cam"


def view(camera: str, output: str) -> str:
    """Image that a view made from `camera`, such as `reproj` or `reproj_height`."""
    return f"observation.images.{camera}_{output}"
