"""Top-down views of camera frames: the interface, the registry, and the two views of the paper."""

from lerobot_symview.views.base import (
    VIEWS,
    Frame,
    View,
    ViewSpec,
    check_gripper,
    make_view,
    make_views,
    other_cameras,
    register_view,
)
from lerobot_symview.views.perspective import PerspectiveView, warp_table
from lerobot_symview.views.reprojection import ReprojectedView, Reprojection, reproject

__all__ = [
    "VIEWS",
    "Frame",
    "PerspectiveView",
    "ReprojectedView",
    "Reprojection",
    "View",
    "ViewSpec",
    "check_gripper",
    "make_view",
    "make_views",
    "other_cameras",
    "register_view",
    "reproject",
    "warp_table",
]
