"""Reproject one RGBD image to a top-down view, and warp its table plane: arrays in, arrays out.

    python examples/view_of_one_image.py --elevation_deg=30

The image comes from the simulator; an image of your own camera works the same way. A pixel of a view is a position on
the table: the example finds the red block by its colour, in metres.
"""

import argparse
import logging
from pathlib import Path

import cv2
import gymnasium
import numpy as np

import lerobot_symview as sv
import symview_sim

logger = logging.getLogger(__name__)


def main(elevation_deg: float, seed: int, output: Path) -> None:
    """Take an image, make both views, and locate the block in one."""
    env = gymnasium.make(symview_sim.gym_id("block_picking"), camera=sv.CameraSpec(elevation_deg=elevation_deg))
    observation, _ = env.reset(seed=seed)
    env.close()
    rgb = observation["pixels"]["side"]  # (H, W, 3) uint8
    depth = observation["images.side_depth"][0]  # (H, W) float32, metres along the optical axis, 0 = invalid
    intrinsics = observation["camera.side.intrinsics"].reshape(3, 3)
    world_from_cam = observation["camera.side.world_from_cam"].reshape(4, 4)  # OpenCV axes

    size = rgb.shape[0]
    camera = sv.Camera(intrinsics, world_from_cam, *rgb.shape[:2])
    workspace = sv.Workspace(center=(0.45, 0.0), size=0.4)  # metres; the table is z = 0
    top = sv.reproject(rgb, depth, camera, workspace, size=size, clip=0.1, source_scale=3)
    table = sv.warp_table(rgb, camera, workspace, size=size)

    output.parent.mkdir(parents=True, exist_ok=True)
    side_by_side = np.hstack([rgb, top.rgb, table])
    cv2.imwrite(str(output), cv2.cvtColor(side_by_side, cv2.COLOR_RGB2BGR))
    logger.info("the image, its reprojection and the warped table plane: %s", output)

    red, green, _ = np.moveaxis(top.rgb.astype(int), -1, 0)
    block = np.argwhere((red > 2 * green) & (top.height > 0.04) & top.seen)  # rows and columns of its top face
    x, y = workspace.xy_from_pixel(block.mean(axis=0), size)
    logger.info("the block is at x = %.3f m, y = %.3f m", x, y)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--elevation_deg", type=float, default=45, help="camera elevation above the table")
    parser.add_argument("--seed", type=int, default=0, help="seed of the block's pose")
    parser.add_argument("--output", type=Path, default=Path("outputs/examples/view_of_one_image.png"))
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
