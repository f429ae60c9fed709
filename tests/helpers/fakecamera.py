"""A LeRobot camera without hardware, `--device.type=fake`. LeRobot finds the class by the name of this module."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from lerobot.cameras import Camera, CameraConfig


@CameraConfig.register_subclass("fake")
@dataclass(kw_only=True)
class FakeCameraConfig(CameraConfig):
    position: float = 0.0


class FakeCamera(Camera):
    """Takes what `see`, which a test sets, returns for the position."""

    see: Callable[[float], np.ndarray]

    def __init__(self, config):
        self.position, self.is_open = config.position, False

    is_connected = property(lambda self: self.is_open)

    def connect(self, warmup=True):
        self.is_open = True

    def read(self):
        assert self.is_open
        return type(self).see(self.position)

    def disconnect(self):
        self.is_open = False

    async_read = read

    @staticmethod
    def find_cameras():
        return []
