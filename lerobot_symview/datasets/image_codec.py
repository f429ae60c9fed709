"""Encoding of images in LeRobot tables: PNG for colour, TIFF for float32 metres, both lossless."""

from __future__ import annotations

import io
import struct
from collections.abc import Buffer
from contextlib import suppress

import cv2
import numpy as np
from numpy.typing import NDArray

PNG_LEVEL = 1  # as in LeRobot: level 6 takes seven times as long for files a tenth smaller
PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"  # first bytes of a file; width and height follow
TIFF, TIFF_WIDTH, TIFF_HEIGHT = {b"II*\0": "<", b"MM\0*": ">"}, 256, 257  # signature -> byte order; tags
TIFF_TYPES = {3: "H", 4: "I"}
NO_COMPRESSION = 1  # TIFF's code


def encoded_size(data: Buffer) -> tuple[int, int]:
    """Return height and width from the header of an encoded image, without decoding it.

    Raises:
        ValueError: if `data` is not an image.
    """
    head = bytes(memoryview(data)[:24])
    if head.startswith(PNG) and len(head) == 24:  # fast path: PIL takes longer than decoding
        width, height = struct.unpack(">II", head[16:])
        return height, width
    if head[:4] in TIFF:
        with suppress(struct.error, KeyError):
            return _tiff_size(memoryview(data), TIFF[head[:4]])
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as image:
            return image.height, image.width
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"expected an image, got {len(memoryview(data))} bytes that are no image: {error}") from None


def _tiff_size(data: memoryview, order: str) -> tuple[int, int]:
    """Return height and width from the first directory; its entries have 12 bytes: tag, type, count, value."""
    (start,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, start)
    values = {}
    for offset in range(start + 2, start + 2 + 12 * count, 12):
        tag, kind, _ = struct.unpack_from(f"{order}HHI", data, offset)
        if tag in (TIFF_WIDTH, TIFF_HEIGHT):
            (values[tag],) = struct.unpack_from(f"{order}{TIFF_TYPES[kind]}", data, offset + 8)
            if len(values) == 2:
                break
    return values[TIFF_HEIGHT], values[TIFF_WIDTH]


def decode_rgb(data: Buffer) -> NDArray[np.uint8]:
    """Decode a colour image to (H, W, 3) uint8 RGB.

    Raises:
        ValueError: if `data` is not an image.
    """
    return np.asarray(_decode(data, cv2.IMREAD_COLOR_RGB), dtype=np.uint8)


def decode_depth(data: Buffer) -> NDArray:
    """Decode a depth image to (H, W), float32 or uint16 as encoded.

    Raises:
        ValueError: if `data` is not a one-channel image of at least 16 bits.
    """
    image = _decode(data, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype.itemsize < 2:
        raise ValueError(
            f"a depth image must have one channel of 16 or 32 bits, got shape {image.shape} of {image.dtype}"
        )
    return image


def encode_rgb(image: NDArray[np.uint8]) -> bytes:
    """Encode an (H, W, 3) uint8 RGB image as PNG."""
    return _encode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])


def encode_metres(image: NDArray[np.float32]) -> bytes:
    """Encode an (H, W) float32 image as uncompressed TIFF."""
    return _encode(".tiff", image, [cv2.IMWRITE_TIFF_COMPRESSION, NO_COMPRESSION])


def _decode(data: Buffer, flags: int) -> NDArray:
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    if image is None:
        raise ValueError(f"expected an image, got {memoryview(data).nbytes} bytes that are no image OpenCV can read")
    return image


def _encode(extension: str, image: NDArray, options: list[int]) -> bytes:
    done, data = cv2.imencode(extension, image, options)
    if not done:
        raise ValueError(f"OpenCV cannot encode {image.dtype} of shape {image.shape} as {extension}")
    return bytes(data)
