"""`lerobot-edit-dataset`: every operation on every kind of dataset of ours, then the uses of a dataset."""

import json
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.scripts.lerobot_edit_dataset import edit_dataset

from lerobot_symview import keys
from lerobot_symview.calibration.file import Calibration, plain_calibration
from lerobot_symview.datasets.add_views import add_views
from lerobot_symview.datasets.card import write_card
from lerobot_symview.datasets.features import stored_workspace
from lerobot_symview.datasets.metadata import read_info
from lerobot_symview.geometry.camera import Camera, intrinsics_from_fov, orbit_pose
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.geometry.workspace import Workspace
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset
from tests.helpers.cameras import plane_depth
from tests.helpers.datasets import in_mm, record_real_robot, views_config

pytestmark = pytest.mark.long

WORKSPACE = Workspace((0.45, 0.02), 0.36)  # not the default one
CAMERAS = {"recorded": "side", "viewed": "side", "only_views": "side", "video": "side", "calibrated": "front"}
OPERATIONS = {
    "merge": [],  # see `edit`
    "split": ['--operation.splits={"train": [0], "val": [1]}'],
    "delete_episodes": ["--operation.episode_indices=[0]"],
    "remove_feature": [],
    "modify_tasks": ["--operation.new_task=another task"],
    "convert_image_to_video": ["--operation.num_workers=1"],
    "recompute_stats": [],
    "reencode_videos": ["--operation.rgb_encoder.vcodec=h264"],
}
EPISODES = {"merge": [(0, 0), (0, 1), (1, 0), (1, 1)], "split": [(0, 0)], "delete_episodes": [(0, 1)]}
"""Operation -> (recording, episode) of every episode of the result; by default the episodes of the first recording."""
REMOVED = {"only_views": keys.view("side", "reproj_height"), "calibrated": keys.view("front", "reproj_height")}
JOINTS = ("--policy.gripper_input=vector", "--policy.state_symmetry=[scalar,scalar,scalar,scalar,scalar,scalar]")
ACTIONS = "--policy.action_symmetry=[x,y,z,yaw,scalar,scalar]"


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Kind -> two datasets that differ in seed, noise, robot, camera placement and expert, or in calibration."""
    root = tmp_path_factory.mktemp("recordings")
    env = RecordedEnv(camera=CameraSpec(height=32, width=32), oracle=False, workspace=WORKSPACE)
    other = replace(env, robot="kuka", camera=replace(env.camera, azimuth_deg=40.0, fov_deg=50.0))

    def record(name, env, seed, **options):
        target = NewDataset("test/recorded", root / name)
        return generate(GenerateConfig(target, env=env, num_episodes=2, seed=seed, **options))

    made = {
        "recorded": [record("a", env, 0), record("b", other, 1, noise=0.2)],
        "video": [record("video_a", env, 0, video=True), record("video_b", other, 1, video=True)],
        "calibrated": [calibrated(root / f"day{day}", distance=0.8 + 0.02 * day) for day in range(2)],
    }
    for kind, kept in (("viewed", None), ("only_views", [])):
        made[kind] = [
            add_views(views_config(folder, root / f"{kind}_{folder.name}", views=["reproj"], keep=kept))
            for folder in made["recorded"]
        ]
    return made


def calibrated(folder, distance):
    camera = Camera(intrinsics_from_fov(0.8, 32, 48), orbit_pose(0.9, 0.4, distance, (0.45, 0.02, 0.0)), 32, 48)
    rgb = np.full((32, 48, 3), (200, 100, 50), dtype=np.uint8)
    record_real_robot(folder, rgb, in_mm(plane_depth(camera)), episodes=2)
    file = folder.with_suffix(".json")
    file.write_text(json.dumps(plain_calibration(Calibration({"front": camera}, WORKSPACE))))
    config = views_config(folder, folder.with_name(f"{folder.name}_views"), camera="front", calibration=file)
    return add_views(replace(config, views=["reproj"]))


@pytest.fixture
def edit(recordings, tmp_path, monkeypatch):
    """A function that edits the recordings of a kind with LeRobot's command and returns the result's folder."""

    def run(operation, kind):
        first, second = recordings[kind]
        target = tmp_path / "edited"
        flags = [f"--operation.type={operation}", *OPERATIONS[operation]]
        if operation == "merge":
            flags += ["--operation.repo_ids=['test/a', 'test/b']", f"--operation.roots=['{first}', '{second}']"]
        elif operation == "modify_tasks":  # in place
            flags += ["--repo_id=test/a", f"--root={shutil.copytree(first, target)}"]
        else:
            flags += ["--repo_id=test/a", f"--root={first}"]
        if operation == "remove_feature":
            flags += [f"--operation.feature_names=['{REMOVED.get(kind, keys.depth(CAMERAS[kind]))}']"]
        if operation != "modify_tasks":
            flags += [f"--new_root={target}"]
        if operation not in ("modify_tasks", "split"):
            flags += ["--new_repo_id=test/edited"]
        monkeypatch.setattr(sys, "argv", ["lerobot-edit-dataset", *flags])
        edit_dataset()
        return target / "train" if operation == "split" else target

    return run


def poses(folder, camera):
    """Pose of the camera in the first frame of every episode."""
    dataset = LeRobotDataset("test/edited", root=folder, video_backend="pyav")
    starts = dataset.meta.episodes["dataset_from_index"]
    return [dataset[int(start)][keys.world_from_cam(camera)].numpy() for start in starts]


@pytest.mark.parametrize("kind", CAMERAS)
@pytest.mark.parametrize("operation", OPERATIONS)
def test_an_edited_dataset_is_used_like_its_source(operation, kind, recordings, edit, tmp_path):
    if kind == "video" and operation == "convert_image_to_video":
        pytest.skip("LeRobot converts datasets without videos only")
    if kind != "video" and operation == "reencode_videos":
        pytest.skip("there is no video")
    source, camera = recordings[kind][0], CAMERAS[kind]
    edited = edit(operation, kind)

    sources = [poses(folder, camera) for folder in recordings[kind]]
    expected = EPISODES.get(operation, [(0, 0), (0, 1)])
    np.testing.assert_array_equal(poses(edited, camera), [sources[day][episode] for day, episode in expected])

    features = read_info(edited)["features"]
    for key, feature in read_info(source)["features"].items():
        if key in features and "info" in feature:
            assert features[key]["info"].get("symview") == feature["info"].get("symview"), key
    assert stored_workspace(features) == WORKSPACE
    write_card(edited, "test/edited", [])

    if kind != "only_views":  # views are rendered from the camera's images
        config = views_config(edited, tmp_path / "views", camera=camera, views=["persp"], size=16)
        if kind == "calibrated":
            config = replace(config, workspace=None)
        dataset = LeRobotDataset("test/derived", root=add_views(config), video_backend="pyav")
        assert dataset[len(dataset) - 1][keys.view(camera, "persp")].shape == (3, 16, 16)
        assert stored_workspace(dataset.meta.features) == WORKSPACE
