"""A LeRobot camera as a flag of commands, `--device.type`, and the images that it takes."""

from __future__ import annotations

import logging
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.runtime.cli import CommandError

logger = logging.getLogger(__name__)

PAUSE = 2.0  # seconds between images, in which a board is moved


def with_device[Config](config_class: type[Config]) -> type[Config]:
    """Return a command's configuration, with the field `device`, a LeRobot camera, if the command line has the flag.

    LeRobot, which takes seconds to import, registers the types of cameras.
    """
    if not any(argument.startswith("--device") for argument in sys.argv):
        return config_class
    from lerobot.cameras import CameraConfig
    from lerobot.cameras.opencv import configuration_opencv  # noqa: F401
    from lerobot.cameras.realsense import configuration_realsense  # noqa: F401
    from lerobot.cameras.zmq import configuration_zmq  # noqa: F401
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()

    @dataclass(frozen=True)
    class WithDevice(config_class):  # type: ignore[misc, valid-type]
        device: CameraConfig | None = None

    WithDevice.__annotations__["device"] = CameraConfig | None
    WithDevice.__doc__ = config_class.__doc__
    return WithDevice


def device_of(config: Any) -> Any:
    """Return the configuration of the LeRobot camera in a command's configuration; None without one."""
    return getattr(config, "device", None)


def take_images(device: Any, count: int = 1) -> list[NDArray[np.uint8]]:
    """Take images (H, W, 3) with a LeRobot camera, given its configuration; between them there is time to move a board.

    Raises:
        CommandError: if the camera fails.
    """
    try:
        return _images(device, count)
    except (ImportError, RuntimeError, OSError) as error:
        raise CommandError(f"--device: {error}") from None


def _images(device: Any, count: int) -> list[NDArray[np.uint8]]:
    from lerobot.cameras.utils import make_cameras_from_configs

    camera = make_cameras_from_configs({"camera": device})["camera"]
    images = []
    camera.connect()
    try:
        for index in range(count):
            if index:
                logger.info("image %d of %d in %.0f s: move the board", index + 1, count, PAUSE)
                time.sleep(PAUSE)
            images.append(np.asarray(camera.read(), dtype=np.uint8))
    finally:
        camera.disconnect()
    return images
