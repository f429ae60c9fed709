"""Cameras, depth images and frames, and planar transforms of them."""

import numpy as np
from hypothesis import strategies as st

from lerobot_symview.geometry.camera import Camera, intrinsics_from_fov, orbit_pose
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import Frame

CENTRE = np.array([0.45, 0.0])
SHAPE = (40, 56)  # rows, columns: not square, so that swapped axes fail


@st.composite
def cameras(draw, shape=SHAPE):
    """A camera 15 to 90 degrees above the table, at any azimuth, with a field of view of 15 to 110 degrees."""
    elevation = draw(st.floats(15, 90))
    azimuth = draw(st.floats(-180, 180))
    distance = draw(st.floats(0.4, 1.5))
    fov = draw(st.floats(15, 110))
    # avoid round numbers, which place points on the edge between two cells
    target = [*(CENTRE + draw(st.floats(-0.05, 0.05)) + [0.0013, 0.0007]), draw(st.floats(0.0, 0.05))]
    pose = orbit_pose(np.deg2rad(elevation), np.deg2rad(azimuth), distance, target)
    return Camera(intrinsics_from_fov(np.deg2rad(fov), *shape), pose, *shape)


def world_transform(quarter_turns, reflect):
    """Planar transform (4, 4): an optional reflection of y, then a rotation about the workspace's centre."""
    angle = quarter_turns * np.pi / 2
    transform = np.eye(4)
    transform[:2, :2] = np.rint([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    if reflect:
        transform[:2, :2] = transform[:2, :2] @ np.diag([1, -1])
    transform[:2, 3] = CENTRE - transform[:2, :2] @ CENTRE
    return transform


def transformed(camera, image, quarter_turns, reflect):
    """Camera and image of the transformed world; a reflection flips the image horizontally."""
    flip = np.diag([-1.0, 1.0, 1.0, 1.0]) if reflect else np.eye(4)
    intrinsics = camera.intrinsics.copy()
    if reflect:
        intrinsics[0, 2] = camera.width - 1 - intrinsics[0, 2]
    pose = world_transform(quarter_turns, reflect) @ camera.world_from_cam @ flip
    return Camera(intrinsics, pose, camera.height, camera.width), image[:, ::-1] if reflect else image


def transformed_image(image, quarter_turns, reflect):
    """Top-down image of the transformed world."""
    return np.rot90(image[:, ::-1] if reflect else image, quarter_turns)


def make_camera(elevation: float = 45.0, azimuth: float = 0.0, size: int = 152, fov: float = 48.0) -> Camera:
    """A camera 0.81 m from the default workspace's centre that looks at it; angles in degrees."""
    return Camera(
        intrinsics_from_fov(np.deg2rad(fov), size, size),
        orbit_pose(np.deg2rad(elevation), np.deg2rad(azimuth), 0.81, (0.45, 0.0, 0.0)),
        size,
        size,
    )


def plane_depth(camera, height=0.0):
    """Depth image of the plane at `height`, metres; 0 where it is not visible."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
    downwards = (rays @ camera.world_from_cam[:3, :3].T)[..., 2]
    with np.errstate(divide="ignore"):
        depth = (height - camera.position[2]) / downwards
    return np.where((downwards < 0) & (depth < 100), depth, 0.0)


def random_depth(seed, shape=SHAPE):
    """Distinct depths of 0.3 to 1.7 m, a tenth of them invalid: 0, negative, NaN or infinite."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.3, 1.7, shape)
    invalid = rng.random(shape) < 0.1
    depth[invalid] = rng.choice([0.0, -1.0, np.nan, np.inf, -np.inf], invalid.sum())
    return depth


def make_frame(camera=None, gripper=(0.0, 0.0, 0.2, 0.0, 1.0), seed=0):
    """Frame with random colours and a smooth depth image with noise."""
    camera = camera or make_camera(size=96)
    rng = np.random.default_rng(seed)
    shape = (camera.height, camera.width)
    depth = 0.75 + 0.05 * np.sin(np.arange(shape[0])[:, None] / 7) + 0.02 * rng.random(shape)
    rgb = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)
    return Frame(rgb, depth.astype(np.float32), camera, Workspace(), np.array(gripper))


MASKS = st.builds(
    lambda seed, share, shape: np.random.default_rng(seed).random(shape) < share,
    st.integers(0, 2**32 - 1),
    st.floats(0.005, 0.9),
    st.tuples(st.integers(1, 20), st.integers(1, 20)),
)
