"""PyBullet, imported and connected without the lines it prints about itself.

pip builds PyBullet without numpy support unless numpy is in the build environment. Such a build returns images as
tuples; `camera_image` converts them.
"""

from __future__ import annotations

import ctypes
import logging
import multiprocessing
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

logger = logging.getLogger(__name__)

VERSION = "3.2.7"
INSTALL = "pip install 'lerobot_policy_symview[sim]'"
REBUILD = (
    "pip install 'numpy>=2,<2.3' 'setuptools<82' wheel && "
    f"pip install --force-reinstall --no-deps --no-build-isolation --no-cache-dir pybullet=={VERSION}"
)
WARNED = "SYMVIEW_PYBULLET_WARNED"  # environment variable that processes started from here inherit


@contextmanager
def silenced() -> Iterator[None]:
    """Discard what C code writes to standard output and standard error meanwhile."""
    libc = ctypes.CDLL(None)
    libc.fflush(None)
    saved = {stream: os.dup(stream) for stream in (1, 2)}
    null = os.open(os.devnull, os.O_WRONLY)
    for stream in saved:
        os.dup2(null, stream)
    try:
        yield
    finally:
        libc.fflush(None)
        for stream, copy in saved.items():
            os.dup2(copy, stream)
            os.close(copy)
        os.close(null)


try:
    with silenced():
        import pybullet
        from pybullet_utils.bullet_client import BulletClient
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(f"the simulated tasks need PyBullet: {INSTALL}", name=error.name) from None


def warn_without_numpy() -> None:
    """Log how to rebuild a PyBullet without numpy support, once for this process and those that it starts."""
    if pybullet.isNumpyEnabled() or WARNED in os.environ or multiprocessing.parent_process() is not None:
        return
    os.environ[WARNED] = "1"
    logger.warning(
        "PyBullet was built without numpy support: images are the same, rendering is slower. Rebuild it with: %s",
        REBUILD,
    )


warn_without_numpy()


class _Client(BulletClient):
    def __del__(self) -> None:
        """Leave disconnecting to the scene: at the interpreter's exit BulletClient's own attempt fails noisily."""


def connect() -> Any:
    """Return a new simulator without a window; its methods are PyBullet's functions bound to this simulator."""
    with silenced():
        return _Client(connection_mode=pybullet.DIRECT)


def camera_image(
    client: Any, width: int, height: int, view: list[float], projection: list[float], **options: Any
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.int32]]:
    """Render an image; the result is bit-identical with and without PyBullet's numpy support.

    Args:
        client: PyBullet client.
        width: columns of the image.
        height: rows of the image.
        view: 16 numbers, the OpenGL view matrix in column-major order.
        projection: 16 numbers, the OpenGL projection matrix in column-major order.
        options: further arguments of `getCameraImage`.

    Returns:
        Colour (H, W, 4) uint8, the depth buffer (H, W) float32 in [0, 1], 1 where nothing is drawn, and the bodies'
        segmentation mask (H, W) int32, whose values mean nothing with `ER_NO_SEGMENTATION_MASK`.
    """
    _, _, rgba, depth, mask = client.getCameraImage(width, height, view, projection, **options)
    return (
        np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4),
        np.asarray(depth, dtype=np.float32).reshape(height, width),
        np.asarray(mask, dtype=np.int32).reshape(height, width),
    )


def disconnect(client: Any) -> None:
    """Shut a simulator down."""
    client.disconnect()


__all__ = ["INSTALL", "REBUILD", "camera_image", "connect", "disconnect", "pybullet", "silenced"]
