"""A board to print, as a PNG or PDF of its true size, with the axes of its frame and its dimensions."""

from __future__ import annotations

import io
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lerobot_symview.calibration.board import Board, board_pattern, pixels_per_square
from lerobot_symview.errors import OptionError

FORMATS = (".pdf", ".png")
DPI = 500, 650  # squares and markers have a whole number of pixels
INCH = 0.0254  # metres
MARGIN = 0.012  # metres: for the axes, the text, and the white border that detection needs
PAPER = {f"A{size}": (0.841 * 2 ** (-size / 2), 1.189 * 2 ** (-size / 2)) for size in (4, 3, 2, 1, 0)}  # metres
TEXT, ARROW = 0.004, 0.03  # metres: height of the text, length of an axis


class Print(NamedTuple):
    """A printable page, (H, W) uint8, 0 or 255, and its resolution in dots per inch."""

    page: NDArray[np.uint8]
    dpi: float


def board_print(board: Board) -> Print:
    """Return a page with the board at its true size, on the smallest of A4 to A0 that holds it."""
    square = pixels_per_square(board, *(round(board.square / INCH * dpi) for dpi in DPI))
    metre = square / board.square  # pixels
    pattern = board_pattern(board, square)
    size = np.array(pattern.shape) + round(2 * MARGIN * metre)
    landscape = [np.round(np.array(sides) * metre).astype(int) for sides in PAPER.values()]
    fitting = [sides for sides in landscape if (sides >= size).all()] or [size]
    page = Image.new("L", tuple(fitting[0][::-1].tolist()), 255)
    top, left = (fitting[0] - pattern.shape) // 2
    page.paste(Image.fromarray(pattern), (left, top))
    _annotate(ImageDraw.Draw(page), board, (int(left), int(top) + pattern.shape[0]), metre)
    return Print(np.asarray(page.point(lambda level: 255 * (level > 127))), metre * INCH)


def encode_print(printed: Print, suffix: str) -> bytes:
    """Return a page as the content of a `.png` or `.pdf` file.

    Raises:
        OptionError: for another suffix.
    """
    if suffix.lower() not in FORMATS:
        raise OptionError(f"expected a file that ends in {' or '.join(FORMATS)}, got {suffix!r}")
    stream, image = io.BytesIO(), Image.fromarray(printed.page).convert("1")
    if suffix.lower() == ".pdf":
        image.save(stream, format="PDF", resolution=printed.dpi)
    else:
        image.save(stream, format="PNG", dpi=(printed.dpi, printed.dpi))
    return stream.getvalue()


def _annotate(draw: ImageDraw.ImageDraw, board: Board, origin: tuple[int, int], metre: float) -> None:
    """Write the dimensions below the board, and draw its axes from its origin, a pixel, into the margin."""
    font = ImageFont.load_default(TEXT * metre)
    x, y = origin
    line, length, away = round(0.0005 * metre), round(ARROW * metre), round(0.004 * metre)
    for tip, label in (((length, 0), "x"), ((0, -length), "y")):
        start = (x, y + away) if label == "x" else (x - away, y)
        end = (start[0] + tip[0], start[1] + tip[1])
        draw.line([start, end], fill=0, width=line)
        across = np.array([-tip[1], tip[0]]) / 20
        back = np.array(end) - np.array(tip) / 10
        draw.polygon([end, tuple(back + across), tuple(back - across)], fill=0)
        draw.text((end[0] + line, end[1]), label, fill=0, font=font, anchor="lm" if label == "x" else "lb")
    text = f"{board}. Print at 100 %, then measure: {board.columns} x {1000 * board.square:g} mm"
    draw.text((x + length + 3 * away, y + away), text, fill=0, font=font, anchor="la")
