"""Every page of the documentation runs as written, at a smaller scale."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset, remove_feature
from PIL import Image

from lerobot_symview import keys
from lerobot_symview.calibration.board import Board
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.placement import CameraSpec
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset
from tests.docs.pages import PAGES, README, ROOT, Reader, blocks, needs
from tests.helpers.boards import close_views, photograph
from tests.helpers.packages import temporary_registrations
from tests.helpers.so101 import record
from tests.hub.client import online
from tests.hub.server import ALICE, HubServer
from tests.malicious.files import change_feature

pytestmark = pytest.mark.long

PROSE = ("index.md", "reference.md")  # lists of other pages


def real_dataset(folder: Path) -> None:
    """Record a dataset as from a real robot: a camera and joints, without calibration and gripper pose."""
    pose = (0, 0.70711, -0.70711, 1.02, 1, 0, 0, 0, 0, -0.70711, -0.70711, 0.57, 0, 0, 0, 1)
    camera = CameraSpec("front", 480, 640, intrinsics=(615.3, 0, 319.5, 0, 615.1, 239.5, 0, 0, 1), world_from_cam=pose)
    env = RecordedEnv(camera=camera, oracle=False)
    whole = generate(GenerateConfig(NewDataset("test/whole", folder.with_name("whole")), env, num_episodes=1))
    calibration_keys = [keys.intrinsics("front"), keys.world_from_cam("front")]
    remove_feature(LeRobotDataset("test/whole", root=whole), calibration_keys, folder, "test/real")
    joints = [f"joint_{number}" for number in range(5)]
    change_feature(folder, keys.STATE, names=joints)
    calibration = (block.text for block in blocks(ROOT / "docs" / "own_camera.md") if block.language == "yaml")
    Path("cameras.yaml").write_text(next(calibration))
    photographs(Camera(np.reshape(camera.intrinsics, (3, 3)), np.reshape(pose, (4, 4)), 480, 640))


def photographs(camera: Camera) -> None:
    """Photograph a board on the table with the camera, and twelve times from nearby for the intrinsics."""
    board, folder = Board(origin=(0.33, -0.08)), Path("photos")
    folder.mkdir()
    views = {"table": camera} | {str(index): view for index, view in enumerate(close_views(board))}
    for name, view in views.items():
        Image.fromarray(photograph(board, view)).save(folder / f"{name}.png")


@pytest.fixture
def reader(request, tmp_path, monkeypatch, recorded, with_views):
    """A page, and a reader with the datasets that the page requires and a Hub."""
    page = request.param
    monkeypatch.chdir(tmp_path)
    reader = Reader(page.stem, monkeypatch)
    datasets = {
        "me/picking": lambda folder: shutil.copytree(recorded, folder),
        "me/picking_views": lambda folder: shutil.copytree(with_views, folder),
        "me/real": real_dataset,
        "me/so101": lambda folder: record(monkeypatch, folder),
    }
    for name in needs(page):
        datasets[name](reader.dataset(name.removeprefix("me/")))
    with HubServer() as hub, online(hub, ALICE), temporary_registrations():
        hub.users[ALICE] = (page.stem, {page.stem})
        yield page, reader
    shutil.rmtree(reader.dataset(""), ignore_errors=True)


@pytest.mark.parametrize(
    "reader", [README, *(page for page in PAGES if page.name not in PROSE)], indirect=True, ids=lambda page: page.stem
)
def test_page_runs(reader):
    page, page_reader = reader
    assert page_reader.follow(page) > 0
