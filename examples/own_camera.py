"""Add views to a dataset without calibration and gripper pose; a file provides the calibration.

    python examples/own_camera.py --dataset=data/real --calibration=cameras.yaml

Without --dataset, demonstrations are simulated and their calibration and state removed.
"""

import argparse
import logging
from pathlib import Path

from lerobot.datasets import LeRobotDataset, remove_feature

from lerobot_symview import AddViewsConfig, CameraSpec, ViewSpec, add_views, keys, read_calibration
from lerobot_symview.datasets.hub import HubDataset
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset

logger = logging.getLogger(__name__)


def record_stand_in(calibration: Path, output_dir: Path) -> Path:
    """Record with the calibration's camera, remove calibration and state, and return the folder."""
    front = read_calibration(calibration).camera("front")
    matrices = {"intrinsics": tuple(front.intrinsics.flat), "world_from_cam": tuple(front.world_from_cam.flat)}
    env = RecordedEnv(camera=CameraSpec("front", front.height, front.width, **matrices), oracle=False)
    folder = generate(GenerateConfig(NewDataset("me/whole", output_dir / "whole"), env, num_episodes=1))
    removed = [keys.intrinsics("front"), keys.world_from_cam("front"), keys.STATE]
    return remove_feature(LeRobotDataset("me/whole", root=folder), removed, output_dir / "real", "me/real").root


def main(dataset: Path | None, calibration: Path, output_dir: Path) -> None:
    """Add the views."""
    config = AddViewsConfig(
        HubDataset("me/real", dataset or record_stand_in(calibration, output_dir)),
        new_root=output_dir / "real_views",
        # The gripper's height is unknown: clip at 20 cm. No gripper image is drawn.
        views=[ViewSpec("reproj", {"clip": 0.2, "source_scale": 2}), ViewSpec("persp")],
        camera="front",
        calibration=calibration,
    )
    result = LeRobotDataset("me/real_views", root=add_views(config))
    logger.info("%d frames with %s", len(result), ", ".join(sorted(result.meta.camera_keys)))
    x, y, z = result[0][keys.world_from_cam("front")].reshape(4, 4)[:3, 3].tolist()
    logger.info("in the first frame, the camera is at (%.2f, %.2f, %.2f) m", x, y, z)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, help="folder of a dataset with the camera `front`")
    parser.add_argument("--calibration", type=Path, default=Path(__file__).with_name("cameras.yaml"))
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/examples/own_camera"))
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
