"""Add both top-down views to a dataset as new camera keys, and draw the images of one frame.

    python examples/add_views.py --dataset=data/picking

Without --dataset, two demonstrations are recorded first. The source dataset is not modified.
"""

import argparse
import logging
from pathlib import Path

from lerobot.datasets import LeRobotDataset
from torchvision.transforms.functional import resize
from torchvision.utils import save_image

from lerobot_symview import AddViewsConfig, ViewSpec, Workspace, add_views, keys
from lerobot_symview.datasets.hub import HubDataset
from symview_sim.generate import GenerateConfig, generate
from symview_sim.settings import NewDataset

logger = logging.getLogger(__name__)


def main(dataset: Path | None, size: int, output_dir: Path) -> None:
    """Add the views and draw one frame."""
    if dataset is None:
        recorded = NewDataset("me/picking", output_dir / "picking")
        dataset = generate(GenerateConfig(recorded, num_episodes=2, resume=True))
    config = AddViewsConfig(
        HubDataset("me/picking", dataset),
        new_root=output_dir / "picking_views",
        views=[
            ViewSpec("reproj", {"infill": "nearest", "mask": True}),
            ViewSpec("persp", {"plane_height": 0.025}),  # metres: half the block's height
        ],
        size=size,
        resume=True,
    )
    folder = add_views(config)

    frame = LeRobotDataset("me/picking_views", root=folder, depth_output_unit="m")[0]
    names = ("side", "side_reproj", "side_reproj_height", "side_reproj_seen", "side_persp", "side_persp_gripper")
    images = {name: frame[keys.rgb(name)] for name in names}
    for name, image in images.items():
        logger.info("%-20s %s", name, tuple(image.shape))
    images["side_reproj_height"] /= Workspace().height_limit  # brightness from metres
    figure = output_dir / "views.png"
    save_image([resize(image.expand(3, -1, -1), [size, size]) for image in images.values()], figure)
    logger.info("the figure is %s", figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, help="folder of a dataset of demonstrations with the camera `side`")
    parser.add_argument("--size", type=int, default=152, help="rows and columns of the views")
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/examples/views"))
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
