"""A camera's image with the world's axes and the workspace drawn in, to check a calibration by eye."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lerobot_symview.geometry.camera import Array, Camera, project
from lerobot_symview.geometry.workspace import Workspace
from symview_eval.contact_sheet import draw_line, with_outline

CORNER = (255, 0, 255)  # RGB
AXES = {"x": (230, 0, 0), "y": (0, 160, 0), "z": (0, 90, 255)}  # RGB
LONGEST = 1280  # pixels: smaller images are enlarged to about this


def calibration_picture(
    rgb: NDArray[np.uint8],
    camera: Camera,
    workspace: Workspace,
    world_from_board: Array | None = None,
    axis: float = 0.1,
    corners: Array | None = None,
    caption: str = "",
) -> Image.Image:
    """Draw a calibration into a camera's image.

    The workspace is red on the table and yellow at its height limit, the axes x, y, z are red, green, blue.

    Args:
        rgb: (H, W, 3) uint8.
        camera: the camera of the image.
        workspace: the workspace.
        world_from_board: (4, 4) frame whose axes are drawn; by default the workspace's centre.
        axis: length of the axes, metres.
        corners: (N, 2) pixels to mark.
        caption: text in the lower left corner.
    """
    drawn = with_outline(rgb, camera, workspace, LONGEST)
    scale, image = len(drawn) // len(rgb), Image.fromarray(drawn)
    draw, width = ImageDraw.Draw(image), max(2, max(image.size) // 400)
    font = ImageFont.load_default(8 * width)
    frame = np.eye(4) if world_from_board is None else world_from_board
    origin = np.array([*workspace.center, 0.0]) if world_from_board is None else frame[:3, 3]
    for direction, (name, color) in zip(frame[:3, :3].T, AXES.items(), strict=True):
        draw_line(draw, camera, scale, origin, origin + axis * direction, color, width)
        tip, depth = project(origin + 1.15 * axis * direction, camera)
        if depth > 0:
            draw.text(tuple((tip + 0.5) * scale), name, fill=color, font=font, anchor="mm")
    for u, v in (np.empty((0, 2)) if corners is None else (corners + 0.5) * scale).tolist():
        draw.ellipse([u - 2 * width, v - 2 * width, u + 2 * width, v + 2 * width], outline=CORNER, width=width // 2)
    if caption:
        box = draw.textbbox((width, image.height - width), caption, font=font, anchor="lb")
        draw.rectangle(box, fill=(0, 0, 0))
        draw.text((width, image.height - width), caption, fill=(255, 255, 255), font=font, anchor="lb")
    return image
