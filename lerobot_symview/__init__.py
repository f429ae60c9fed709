"""Views from above of what a freely placed camera sees: geometry and views, without simulator or network."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lerobot_symview.geometry.camera import CalibrationError as CalibrationError
    from lerobot_symview.geometry.camera import Camera as Camera
    from lerobot_symview.geometry.placement import CameraSpec as CameraSpec
    from lerobot_symview.geometry.workspace import Workspace as Workspace
    from lerobot_symview.views import VIEWS as VIEWS
    from lerobot_symview.views import Frame as Frame
    from lerobot_symview.views import PerspectiveView as PerspectiveView
    from lerobot_symview.views import ReprojectedView as ReprojectedView
    from lerobot_symview.views import View as View
    from lerobot_symview.views import make_view as make_view
    from lerobot_symview.views import register_view as register_view

# Loaded when they are asked for: views need OpenCV, which a simulator's process can do without.
_HOMES = {
    "geometry.camera": ("CalibrationError", "Camera"),
    "geometry.placement": ("CameraSpec",),
    "views": ("VIEWS", "Frame", "PerspectiveView", "ReprojectedView", "View", "make_view", "register_view"),
    "geometry.workspace": ("Workspace",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Return a public name from the module that defines it."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_HOME)
