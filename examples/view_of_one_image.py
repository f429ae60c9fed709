"""Make views of one image, its depth and its camera's matrices: arrays in, arrays out.

    python examples/view_of_one_image.py --elevation_deg=30

The image is the simulator's, through Gymnasium; one of your own camera goes the same way. In a view, pixels are places
on the table: the red block is found by its colour, in metres.
"""

import argparse
import logging
from pathlib import Path

import cv2
import gymnasium
import numpy as np

import symview_sim
from lerobot_symview import Camera, CameraSpec, Frame, Workspace, make_view

logger = logging.getLogger(__name__)


def main(elevation_deg: float, seed: int, picture: Path) -> None:
    """Take an image, make both views, and find the block in one."""
    env = gymnasium.make(symview_sim.gym_id("block_picking"), camera=CameraSpec(elevation_deg=elevation_deg))
    observation, _ = env.reset(seed=seed)
    env.close()
    rgb = observation["pixels"]["side"]  # (H, W, 3) uint8
    depth = observation["images.side_depth"][0]  # (H, W) float32, metres along the optical axis, 0 = invalid
    intrinsics = observation["camera.side.intrinsics"].reshape(3, 3)
    world_from_cam = observation["camera.side.world_from_cam"].reshape(4, 4)  # OpenCV axes

    workspace = Workspace(center=(0.45, 0.0), size=0.4)  # metres; the table is z = 0
    frame = Frame(rgb, depth, Camera(intrinsics, world_from_cam, *rgb.shape[:2]), workspace)
    size = rgb.shape[0]
    reproj = make_view("reproj", size=size, clip=0.1, source_scale=3, mask=True).render(frame)
    persp = make_view("persp", size=size, gripper=False).render(frame)

    picture.parent.mkdir(parents=True, exist_ok=True)
    side_by_side = np.hstack([rgb, reproj["reproj"], persp["persp"]])
    cv2.imwrite(str(picture), cv2.cvtColor(side_by_side, cv2.COLOR_RGB2BGR))
    logger.info("the image, reprojected, and with the table's plane warped: %s", picture)

    red, green, _ = np.moveaxis(reproj["reproj"].astype(int), -1, 0)
    seen = reproj["reproj_seen"][..., 0] > 0  # rather than inferred from what is near
    block = np.argwhere((red > 2 * green) & (reproj["reproj_height"] > 0.04) & seen)  # its top: rows and columns
    x, y = workspace.xy_from_pixel(block.mean(axis=0), size)
    logger.info("the block is at x = %.3f m, y = %.3f m", x, y)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--elevation_deg", type=float, default=45, help="of the camera above the table")
    parser.add_argument("--seed", type=int, default=0, help="where the block lies")
    parser.add_argument("--picture", type=Path, default=Path("outputs/examples/view_of_one_image.png"))
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
