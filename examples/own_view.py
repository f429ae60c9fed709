"""A view of your own: height above the table as colour, for policies that take images of three channels only.

    python examples/own_view.py

The decorator registers the view in this process; an entry point of a package makes it known to the commands, see
docs/own_view.md.
"""

import argparse
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from lerobot.datasets import LeRobotDataset

from lerobot_symview import AddViewsConfig, Frame, View, ViewSpec, add_views, keys, make_view, register_view
from lerobot_symview.datasets.hub import HubDataset
from symview_sim.generate import GenerateConfig, generate
from symview_sim.settings import NewDataset

logger = logging.getLogger(__name__)


@register_view("relief")
@dataclass(frozen=True)
class ReliefView(View):
    """Blue on the table, red at `highest` metres and above; the arm is clipped as in `reproj`."""

    size: int = 152
    highest: float = 0.1
    outputs: ClassVar = {"relief": "rgb"}
    needs_depth = uses_gripper = True

    def render(self, frame: Frame) -> dict[str, np.ndarray]:
        """Return the image, (size, size, 3) uint8."""
        height = make_view("reproj", size=self.size).render(frame)["reproj_height"]
        grey = np.uint8(255 * np.clip(height / self.highest, 0, 1))
        return {"relief": cv2.cvtColor(cv2.applyColorMap(grey, cv2.COLORMAP_JET), cv2.COLOR_BGR2RGB)}


def main(size: int, output_dir: Path) -> None:
    """Record a demonstration and add the view by name."""
    folder = generate(GenerateConfig(NewDataset("me/picking", output_dir / "picking"), num_episodes=1, resume=True))
    options = {"new_root": output_dir / "relief", "views": [ViewSpec("relief")], "size": size, "resume": True}
    folder = add_views(AddViewsConfig(HubDataset("me/picking", folder), **options))
    result, key = LeRobotDataset("me/picking_views", root=folder), keys.view("side", "relief")
    stored = result.meta.features[key]["info"]["symview"]["options"]  # to render the same view on a robot
    logger.info("%d images %s by %s", len(result), tuple(result[0][key].shape), make_view("relief", **stored))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=152, help="rows and columns of the view")
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/examples/own_view"))
    logging.basicConfig(level=logging.ERROR, format="%(message)s", force=True)
    logger.setLevel(logging.INFO)
    main(**vars(parser.parse_args()))
