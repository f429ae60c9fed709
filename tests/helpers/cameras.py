"""Cameras, depth images and frames, and what rotates and reflects them."""

import numpy as np
from hypothesis import strategies as st

from lerobot_symview.geometry.camera import Camera, intrinsics_from_fov, orbit_pose
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import Frame

CENTRE = np.array([0.45, 0.0])
SHAPE = (40, 56)  # rows, columns: not square, so that mixing them up shows


@st.composite
def cameras(draw, shape=SHAPE):
    """A camera at 15 to 90 degrees above the table, from any side, of any field of view."""
    elevation = draw(st.floats(15, 90))
    azimuth = draw(st.floats(-180, 180))
    distance = draw(st.floats(0.4, 1.5))
    fov = draw(st.floats(15, 110))
    # away from round numbers, where a point could fall onto the edge between two cells
    target = [*(CENTRE + draw(st.floats(-0.05, 0.05)) + [0.0013, 0.0007]), draw(st.floats(0.0, 0.05))]
    pose = orbit_pose(np.deg2rad(elevation), np.deg2rad(azimuth), distance, target)
    return Camera(intrinsics_from_fov(np.deg2rad(fov), *shape), pose, *shape)


def world_motion(quarter_turns, mirror):
    """Matrix (4, 4) that turns the world about the workspace's centre after mirroring y, if asked."""
    angle = quarter_turns * np.pi / 2
    motion = np.eye(4)
    motion[:2, :2] = np.rint([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    if mirror:
        motion[:2, :2] = motion[:2, :2] @ np.diag([1, -1])
    motion[:2, 3] = CENTRE - motion[:2, :2] @ CENTRE
    return motion


def moved(camera, image, quarter_turns, mirror):
    """What sees the moved world as `camera` sees the world, and its image: a mirror image swaps left and right."""
    flip = np.diag([-1.0, 1.0, 1.0, 1.0]) if mirror else np.eye(4)
    intrinsics = camera.intrinsics.copy()
    if mirror:
        intrinsics[0, 2] = camera.width - 1 - intrinsics[0, 2]
    pose = world_motion(quarter_turns, mirror) @ camera.world_from_cam @ flip
    return Camera(intrinsics, pose, camera.height, camera.width), image[:, ::-1] if mirror else image


def moved_picture(picture, quarter_turns, mirror):
    """The top-down image of the moved world."""
    return np.rot90(picture[:, ::-1] if mirror else picture, quarter_turns)


def make_camera(elevation: float = 45.0, azimuth: float = 0.0, size: int = 152, fov: float = 48.0) -> Camera:
    """A camera that looks at the default workspace's centre from 0.81 m; angles in degrees."""
    return Camera(
        intrinsics_from_fov(np.deg2rad(fov), size, size),
        orbit_pose(np.deg2rad(elevation), np.deg2rad(azimuth), 0.81, (0.45, 0.0, 0.0)),
        size,
        size,
    )


def plane_depth(camera, height=0.0):
    """Depth of the plane at `height` seen by `camera`, 0 where it does not see it."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
    downwards = (rays @ camera.world_from_cam[:3, :3].T)[..., 2]
    with np.errstate(divide="ignore"):
        depth = (height - camera.position[2]) / downwards
    return np.where((downwards < 0) & (depth < 100), depth, 0.0)


def random_depth(seed, shape=SHAPE):
    """Depths of 0.3 to 1.7 m without equals, a tenth of them invalid in every way there is."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.3, 1.7, shape)
    invalid = rng.random(shape) < 0.1
    depth[invalid] = rng.choice([0.0, -1.0, np.nan, np.inf, -np.inf], invalid.sum())
    return depth


def make_frame(camera=None, gripper=(0.0, 0.0, 0.2, 0.0, 1.0), seed=0):
    """Random colours over a smooth random relief, as `camera` could measure it."""
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
