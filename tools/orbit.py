"""Render the README's animation: a camera swings around the table, and the top-down view stays the same.

    python tools/orbit.py --output=docs/images/orbit.gif

Left: the side camera's image, with the border of the workspace drawn on the table. Right: the view that `reproj`
computes from that image, its depth, the camera's calibration and the gripper's state. The scene is simulated once: the
scripted expert of block picking reaches for the red block, beside three coloured bricks. Only the camera moves. It
swings 160 degrees and back. From the rest of the circle the arm hides bricks, and infill would replace them by their
neighbours. The result depends on the options alone.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gymnasium
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

import symview_sim
from lerobot_symview.geometry.camera import Camera, project
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import Frame, ReprojectedView
from symview_sim.env import SymviewEnv
from symview_sim.rendering import render

TASK, SEED, ACTIONS = "block_picking", 14, 1
CAMERA = CameraSpec(fov_deg=27.0, elevation_deg=50.0, distance=1.5)
SWING = (-145.0, 15.0)  # degrees of azimuth, between which the arm hides little of the workspace
BRICKS = (  # size (m), colour, centre relative to the workspace's (m), yaw (rad)
    ((0.09, 0.045, 0.022), (0.10, 0.35, 0.85), (-0.07, -0.13), 0.5),
    ((0.06, 0.06, 0.022), (0.98, 0.75, 0.10), (0.09, -0.12), 0.2),
    ((0.09, 0.03, 0.022), (0.10, 0.62, 0.35), (-0.12, 0.13), -0.9),
)
OVERSAMPLING = 3  # camera pixels per pixel of the animation: PyBullet's software renderer does not smooth edges
BORDER, BORDER_POINTS, BORDER_TOLERANCE = (0, 128, 128), 400, 0.01  # colour; points per side; metres
MARGIN, LABEL_HEIGHT = 8, 26  # pixels
LABELS = ("side camera (RGBD)", "top-down view made from that image")
PALETTE = 80  # colours


def make_scene(env: SymviewEnv) -> NDArray[np.float32]:
    """Reset `env`, add the bricks, let the expert act, and return the gripper's state (5,)."""
    env.reset(seed=SEED)
    for size, color, (x, y), yaw in BRICKS:
        place = (env.workspace.center[0] + x, env.workspace.center[1] + y, size[2] / 2)
        env.scene.add_box(size, 0.1, 1.0, color, place, yaw)
    for _ in range(ACTIONS):
        observation, *_ = env.step(env.expert_action())
    state: NDArray[np.float32] = observation["agent_pos"]
    return state


def swing(frames: int) -> list[float]:
    """Return the azimuths of `frames` frames, degrees: from one end to the other and back, slower at the ends."""
    first, last = SWING
    phases = [min(index, frames - index) / frames for index in range(frames)]  # the way back repeats the way there
    return [first + (last - first) * (1 - np.cos(2 * np.pi * phase)) / 2 for phase in phases]


def camera_at(azimuth_deg: float, pixels: int, workspace: Workspace) -> Camera:
    """Return the calibrated camera of `pixels` x `pixels` at an azimuth, which looks at the workspace's centre."""
    angles = {"elevation_deg": CAMERA.elevation_deg, "distance": CAMERA.distance, "fov_deg": CAMERA.fov_deg}
    return CameraSpec(height=pixels, width=pixels, azimuth_deg=azimuth_deg, **angles).place(workspace)


def render_pair(
    env: SymviewEnv, gripper: NDArray[np.float32], azimuth_deg: float, size: int
) -> tuple[Image.Image, Image.Image]:
    """Return the side image and the top-down view made from it, `size` x `size` pixels each."""
    pixels = OVERSAMPLING * size
    camera = camera_at(azimuth_deg, pixels, env.workspace)
    image = render(env.scene.client, camera)
    view = ReprojectedView(size=2 * size, source_scale=2, height=False)
    topdown = view.render(Frame(image.rgb, image.depth, camera, env.workspace, gripper))["reproj"]
    outlined = draw_border(image.rgb, image.depth, camera, env.workspace)
    return _resized(outlined, size), _resized(topdown, size)


def draw_border(
    rgb: NDArray[np.uint8], depth: NDArray[np.float32], camera: Camera, workspace: Workspace
) -> NDArray[np.uint8]:
    """Return a copy of `rgb` with the workspace's border on the table, except where something stands before it."""
    corners = workspace.corners()
    share = np.linspace(0, 1, BORDER_POINTS * OVERSAMPLING)[:, None]
    border = np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)])
    uv, distance = project(border, camera)
    columns, rows = np.rint(uv).astype(int).T
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    columns, rows, distance = columns[inside], rows[inside], distance[inside]
    free = depth[rows, columns] > distance - BORDER_TOLERANCE
    mask = np.zeros(depth.shape, dtype=bool)
    for down in range(-OVERSAMPLING, OVERSAMPLING + 1):
        for right in range(-OVERSAMPLING, OVERSAMPLING + 1):
            if down**2 + right**2 <= OVERSAMPLING**2:
                row, column = rows[free] + down, columns[free] + right
                mask[np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1)] = True
    return np.where(mask[..., None], np.array(BORDER, dtype=np.uint8), rgb)


def compose(side: Image.Image, topdown: Image.Image) -> Image.Image:
    """Return both images beside each other on white, labelled below; the view is framed in the border's colour."""
    size = side.width
    sheet = Image.new("RGB", (2 * size + 3 * MARGIN, size + 2 * MARGIN + LABEL_HEIGHT), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(max(9, size // 21))
    for image, label, left in zip((side, topdown), LABELS, (MARGIN, size + 2 * MARGIN), strict=True):
        sheet.paste(image, (left, MARGIN))
        middle = (left + size / 2, MARGIN + size + LABEL_HEIGHT / 2 + 2)
        draw.text(middle, label, fill=(50, 50, 50), font=font, anchor="mm")
    left = size + 2 * MARGIN
    draw.rectangle((left - 2, MARGIN - 2, left + size + 1, MARGIN + size + 1), outline=BORDER, width=2)
    return sheet


def save_gif(frames: list[Image.Image], path: Path, frames_per_second: float) -> None:
    """Write an endless GIF whose frames share one palette, without dithering, which flickers and compresses badly."""
    some = frames[:: max(1, len(frames) // 12)]
    samples = Image.fromarray(np.vstack([np.asarray(frame) for frame in some]))
    palette = samples.quantize(PALETTE, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    paletted = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    path.parent.mkdir(parents=True, exist_ok=True)
    duration = round(1000 / frames_per_second)
    paletted[0].save(path, save_all=True, append_images=paletted[1:], duration=duration, loop=0, optimize=True)


def main(output: Path, frames: int, size: int, frames_per_second: float) -> None:
    """Simulate the scene once, render it from every azimuth of the swing and back, and write the animation."""
    env: SymviewEnv = gymnasium.make(symview_sim.gym_id(TASK)).unwrapped  # type: ignore[assignment]
    azimuths = swing(frames)
    try:
        gripper = make_scene(env)
        images = {azimuth: compose(*render_pair(env, gripper, azimuth, size)) for azimuth in set(azimuths)}
    finally:
        env.close()
    save_gif([images[azimuth] for azimuth in azimuths], output, frames_per_second)


def _resized(image: NDArray[np.uint8], size: int) -> Image.Image:
    return Image.fromarray(image).resize((size, size), Image.Resampling.BOX)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("docs/images/orbit.gif"))
    parser.add_argument("--frames", type=int, default=42, help="there and back")
    parser.add_argument("--size", type=int, default=336, help="rows and columns of either image, pixels")
    parser.add_argument("--frames_per_second", type=float, default=10)
    main(**vars(parser.parse_args()))
