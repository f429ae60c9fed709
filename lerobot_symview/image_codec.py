"""How a LeRobot dataset keeps images in its tables: PNG for colour, TIFF for metres, both without loss."""

from __future__ import annotations

from collections.abc import Buffer

import cv2
import numpy as np
from numpy.typing import NDArray

PNG_LEVEL = 1  # LeRobot's own: level 6 takes seven times as long for a tenth less
NO_COMPRESSION = 1  # TIFF's code for none


def decode_rgb(data: Buffer) -> NDArray[np.uint8]:
    """Return (H, W, 3) uint8 of an encoded colour image.

    Raises:
        ValueError: if `data` is no image.
    """
    return np.asarray(_decode(data, cv2.IMREAD_COLOR_RGB), dtype=np.uint8)


def decode_depth(data: Buffer) -> NDArray:
    """Return (H, W) float32 or uint16, whatever was encoded.

    Raises:
        ValueError: if `data` is no image of one channel.
    """
    image = _decode(data, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2:
        raise ValueError(f"a depth image must have one channel, got shape {image.shape}")
    return image


def encode_rgb(image: NDArray[np.uint8]) -> bytes:
    """Return (H, W, 3) uint8 as PNG."""
    return _encode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])


def encode_metres(image: NDArray[np.float32]) -> bytes:
    """Return (H, W) float32 as TIFF."""
    return _encode(".tiff", image, [cv2.IMWRITE_TIFF_COMPRESSION, NO_COMPRESSION])


def _decode(data: Buffer, flags: int) -> NDArray:
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    if image is None:
        raise ValueError(f"{memoryview(data).nbytes} bytes that are no image OpenCV can read")
    return image


def _encode(extension: str, image: NDArray, options: list[int]) -> bytes:
    done, data = cv2.imencode(extension, image, options)
    if not done:
        raise ValueError(f"OpenCV cannot encode {image.dtype} of shape {image.shape} as {extension}")
    return bytes(data)
