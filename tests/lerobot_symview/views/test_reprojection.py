"""The view `reproj`: what of the point cloud it shows."""

import numpy as np

from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import Frame, make_view
from tests.helpers.cameras import make_camera, plane_depth


def test_the_floor_beside_the_table_is_not_shown():
    """Beyond the table's edge the camera sees the floor, 15 cm lower; its points fall into empty cells of the table."""
    camera = make_camera(size=152)
    table, floor = plane_depth(camera), plane_depth(camera, -0.15)
    v, u = np.mgrid[:152, :152]
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
    x = ((rays * table[..., None]) @ camera.world_from_cam[:3, :3].T + camera.position)[..., 0]
    is_floor = x > Workspace().center[0]  # the table ends in the middle of the workspace, towards the camera
    depth = np.where(is_floor, floor, table).astype(np.float32)
    rgb = np.where(is_floor[..., None], 255, 60).astype(np.uint8).repeat(3, axis=2)
    frame = Frame(rgb, depth, camera, Workspace())
    shown = make_view("reproj", lowest=-2.0).render(frame)
    cut = make_view("reproj").render(frame)
    assert (shown["reproj"] == 255).any()
    assert (shown["reproj_height"] < -0.1).any()
    assert (cut["reproj"] == 60).all()
    assert np.abs(cut["reproj_height"]).max() < 1e-4
