"""Contact sheets: labelled images in rows, as a PNG image and as a self-contained HTML page."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass, field

import jinja2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lerobot_symview.geometry.camera import Camera, project
from lerobot_symview.geometry.workspace import Workspace

TILE, GAP, LABEL = 228, 8, 24  # pixels
LINE = 1.5  # pixels of a tile: width of an outline, whatever the size of the image
OUTLINE, CEILING = (255, 60, 0), (255, 190, 0)  # RGB of the workspace's border on the table and at its height limit
LINE_POINTS = 32  # per line in space; segments that reach behind the camera are not drawn


@dataclass(frozen=True)
class SheetRow:
    """One row of a contact sheet: the images of one frame."""

    title: str
    """Heading, such as the episode and frame number."""
    facts: list[str]
    """Measurements to print under the heading."""
    images: dict[str, NDArray[np.uint8]] = field(repr=False)
    """Label -> image (H, W, 3) uint8 RGB."""


def montage(rows: list[SheetRow]) -> Image.Image:
    """Return the contact sheet as one image; every image is scaled to a tile and labelled."""
    columns = max(len(row.images) for row in rows)
    row_height = TILE + 2 * LABEL + 2 * GAP
    sheet = Image.new("RGB", (columns * (TILE + GAP) + GAP, len(rows) * row_height), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(14)
    for index, row in enumerate(rows):
        top = index * row_height
        draw.text((GAP, top + GAP // 2), " · ".join([row.title, *row.facts]), fill="black", font=font)
        for column, (name, image) in enumerate(row.images.items()):
            left = GAP + column * (TILE + GAP)
            draw.text((left, top + LABEL), name, fill=(90, 90, 90), font=font)
            sheet.paste(_tile(image), (left, top + 2 * LABEL))
    return sheet


def page(title: str, rows: list[SheetRow], warnings: list[str], declaration: list[str]) -> str:
    """Return the contact sheet as an HTML page; it embeds the images at their own size and the browser scales them.

    Args:
        title: heading.
        rows: of images.
        warnings: sentences above them.
        declaration: sentences on the declared types, below them.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("symview_eval"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    embedded = [(row, [(name, png_uri(image)) for name, image in row.images.items()]) for row in rows]
    return environment.get_template("preview.html").render(
        title=title, rows=embedded, warnings=warnings, declaration=declaration, tile=TILE
    )


def with_outline(
    rgb: NDArray[np.uint8], camera: Camera, workspace: Workspace, longest: int = 2 * TILE
) -> NDArray[np.uint8]:
    """Draw the workspace's border on the table (red) and at its height limit (yellow) into a camera's image.

    Args:
        rgb: (H, W, 3) uint8.
        camera: the camera of the image.
        workspace: the workspace.
        longest: pixels to which the longer side of a smaller image is about enlarged.

    Returns:
        The image, enlarged by a whole number, (s H, s W, 3) uint8.
    """
    scale = max(1, round(longest / max(rgb.shape[:2])))
    image = Image.fromarray(rgb.repeat(scale, axis=0).repeat(scale, axis=1))
    draw = ImageDraw.Draw(image)
    width = max(2, round(LINE * max(image.size) / TILE))
    for height, color in ((workspace.height_limit, CEILING), (0.0, OUTLINE)):
        corners = workspace.corners(height)
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            draw_line(draw, camera, scale, start, end, color, width)
    return np.asarray(image)


def draw_line(
    draw: ImageDraw.ImageDraw,
    camera: Camera,
    scale: int,
    start: NDArray[np.floating],
    end: NDArray[np.floating],
    color: tuple[int, int, int],
    width: int,
) -> None:
    """Draw a line in space, from `start` to `end` (3,), into a camera's image that is enlarged by `scale`."""
    pixels, depth = project(start + np.linspace(0, 1, LINE_POINTS)[:, None] * (end - start), camera)
    points = [tuple(point) for point in ((pixels + 0.5) * scale).tolist()]
    for first, second, near, far in zip(points, points[1:], depth, depth[1:], strict=False):
        if near > 0 and far > 0:
            draw.line([first, second], fill=color, width=width)


def grey(metres: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Convert an (H, W) image in metres to grey levels (H, W, 3) uint8: its minimum is black, its maximum white."""
    low, high = float(metres.min()), float(metres.max())
    levels = np.rint(255 * (metres - low) / max(high - low, 1e-6)).astype(np.uint8)
    return np.repeat(levels[..., None], 3, axis=-1)


def png_uri(image: NDArray[np.uint8]) -> str:
    """Return an image as the data URI of a PNG."""
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, format="PNG")
    return data_uri("image/png", stream.getvalue())


def data_uri(mime_type: str, content: bytes) -> str:
    """Return a data URI that embeds the content."""
    return f"data:{mime_type};base64,{base64.b64encode(content).decode()}"


def _tile(image: NDArray[np.uint8]) -> Image.Image:
    """Scale an image so that its longer side has TILE pixels."""
    height, width = image.shape[:2]
    scale = TILE / max(height, width)
    size = (max(1, round(scale * width)), max(1, round(scale * height)))
    resampling = Image.Resampling.NEAREST if scale >= 1 else Image.Resampling.BOX
    return Image.fromarray(image).resize(size, resampling)
