"""Cameras and worlds that Hypothesis draws, and what turns and mirrors them."""

import numpy as np
from hypothesis import strategies as st

from lerobot_symview.geometry.camera import Camera, intrinsics_from_fov, orbit_pose

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
