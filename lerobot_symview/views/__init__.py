"""Top-down views of camera frames: what a view is, the registry, and the two views of the paper."""

from lerobot_symview.views.base import VIEWS, Frame, View, check_gripper, choose_views, make_view, register_view
from lerobot_symview.views.perspective import PerspectiveView
from lerobot_symview.views.reprojection import ReprojectedView

__all__ = [
    "VIEWS",
    "Frame",
    "PerspectiveView",
    "ReprojectedView",
    "View",
    "check_gripper",
    "choose_views",
    "make_view",
    "register_view",
]
