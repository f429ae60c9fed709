"""Top-down views from freely placed cameras: geometry, views, calibration and datasets.

```python
import lerobot_symview as sv

camera = sv.Camera(K, world_from_cam, height=480, width=640)
top = sv.reproject(rgb, depth, camera, sv.Workspace(center=(0.45, 0.0), size=0.4))
```

This package imports neither a simulator nor a neural network. Public names are imported on first use, so that simulator
processes do not load OpenCV.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lerobot_symview.calibration.file import Calibration as Calibration
    from lerobot_symview.calibration.read import read_calibration as read_calibration
    from lerobot_symview.datasets.add_views import AddViewsConfig as AddViewsConfig
    from lerobot_symview.datasets.add_views import add_views as add_views
    from lerobot_symview.datasets.hub import HubDataset as HubDataset
    from lerobot_symview.errors import CalibrationError as CalibrationError
    from lerobot_symview.errors import DatasetError as DatasetError
    from lerobot_symview.errors import DivergenceError as DivergenceError
    from lerobot_symview.errors import OptionError as OptionError
    from lerobot_symview.errors import SymviewError as SymviewError
    from lerobot_symview.geometry.camera import Camera as Camera
    from lerobot_symview.geometry.camera import project as project
    from lerobot_symview.geometry.camera import unproject as unproject
    from lerobot_symview.geometry.placement import CameraSpec as CameraSpec
    from lerobot_symview.geometry.workspace import Workspace as Workspace
    from lerobot_symview.views import VIEWS as VIEWS
    from lerobot_symview.views import Frame as Frame
    from lerobot_symview.views import PerspectiveView as PerspectiveView
    from lerobot_symview.views import ReprojectedView as ReprojectedView
    from lerobot_symview.views import View as View
    from lerobot_symview.views import ViewSpec as ViewSpec
    from lerobot_symview.views import make_view as make_view
    from lerobot_symview.views import register_view as register_view
    from lerobot_symview.views import reproject as reproject
    from lerobot_symview.views import warp_table as warp_table

_NAMES_OF_MODULE = {
    "calibration.file": ("Calibration",),
    "calibration.read": ("read_calibration",),
    "datasets.add_views": ("AddViewsConfig", "add_views"),
    "datasets.hub": ("HubDataset",),
    "errors": ("CalibrationError", "DatasetError", "DivergenceError", "OptionError", "SymviewError"),
    "geometry.camera": ("Camera", "project", "unproject"),
    "geometry.placement": ("CameraSpec",),
    "geometry.workspace": ("Workspace",),
    "views": (
        "VIEWS",
        "Frame",
        "PerspectiveView",
        "ReprojectedView",
        "View",
        "ViewSpec",
        "make_view",
        "register_view",
        "reproject",
        "warp_table",
    ),
}
_MODULE_OF_NAME = {name: module for module, names in _NAMES_OF_MODULE.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name not in _MODULE_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF_NAME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_MODULE_OF_NAME)
