"""Views from above of what a freely placed camera sees: geometry and views, without simulator or network."""

from lerobot_symview.camera import CalibrationError, Camera
from lerobot_symview.placement import CameraSpec
from lerobot_symview.views import VIEWS, Frame, PerspectiveView, ReprojectedView, View, make_view, register_view
from lerobot_symview.workspace import Workspace

__all__ = [
    "VIEWS",
    "CalibrationError",
    "Camera",
    "CameraSpec",
    "Frame",
    "PerspectiveView",
    "ReprojectedView",
    "View",
    "Workspace",
    "make_view",
    "register_view",
]
