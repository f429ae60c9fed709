"""`lerobot-edit-dataset` on datasets of ours: every operation on every kind of dataset, then views and training."""

import json
import shutil
import sys
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors
from lerobot.scripts.lerobot_edit_dataset import edit_dataset

from lerobot_policy_symview.rl.demonstrations import check_scene
from lerobot_symview import keys
from lerobot_symview.calibration.file import Calibration, parse_calibration, plain_calibration
from lerobot_symview.datasets.add_views import add_views
from lerobot_symview.datasets.card import write_card
from lerobot_symview.datasets.features import stored_workspace
from lerobot_symview.datasets.metadata import read_info
from lerobot_symview.datasets.source import EpisodeTables, SourceDataset
from lerobot_symview.geometry.camera import Camera, intrinsics_from_fov, orbit_pose
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.staging import plain
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import EnvSettings, NewDataset
from tests.conftest import VIEW_SIZE
from tests.helpers.cameras import plane_depth
from tests.helpers.datasets import change_feature, in_mm, record_real_robot, views_config
from tests.helpers.policies import make_config
from tests.helpers.training import train

pytestmark = pytest.mark.long

WORKSPACE = Workspace((0.45, 0.02), 0.36)  # not the default one
SIDE = CameraSpec(height=32, width=32)
CAMERAS = {"recorded": "side", "viewed": "side", "video": "side", "calibrated": "front"}
OPERATIONS = {
    "merge": [],
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
NO_IMAGE_STATISTICS = "--dataset.use_imagenet_stats=false"  # LeRobot does not write them where it converts to video
JOINTS = [
    "--policy.camera=front",
    "--policy.gripper_input=vector",
    "--policy.state_symmetry=[scalar,scalar,scalar,scalar,scalar,scalar]",
    "--policy.action_symmetry=[x,y,z,yaw,scalar,scalar]",
]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Kind -> two datasets that differ in seed, noise, robot and camera placement, or in calibration."""
    root = tmp_path_factory.mktemp("recordings")
    env = RecordedEnv(camera=SIDE, oracle=False, workspace=WORKSPACE)
    other = replace(env, robot="kuka", camera=replace(SIDE, azimuth_deg=40.0, fov_deg=50.0))

    def record(name, env, **options):
        return generate(GenerateConfig(NewDataset("test/recorded", root / name), env=env, num_episodes=2, **options))

    recorded = [record("a", env), record("b", other, seed=1, noise=0.2)]
    return {
        "recorded": recorded,
        "viewed": [
            add_views(views_config(source, source.with_suffix(".views"), views=["reproj"])) for source in recorded
        ],
        "video": [record("video_a", env, video=True), record("video_b", other, seed=1, video=True)],
        "calibrated": [record_with_calibration_file(root / f"day{day}", 0.8 + 0.02 * day) for day in range(2)],
    }


def record_with_calibration_file(folder, distance):
    """Record a real robot and add a view by the calibration of a camera at a distance from the workspace's centre."""
    camera = Camera(intrinsics_from_fov(0.8, 32, 48), orbit_pose(0.9, 0.4, distance, (0.45, 0.02, 0.0)), 32, 48)
    rgb = np.full((32, 48, 3), (200, 100, 50), dtype=np.uint8)
    record_real_robot(folder, rgb, in_mm(plane_depth(camera)), episodes=2)
    file = folder.with_suffix(".json")
    file.write_text(json.dumps(plain_calibration(Calibration({"front": camera}, WORKSPACE))))
    config = views_config(folder, folder.with_suffix(".views"), camera="front", calibration=file, views=["reproj"])
    return add_views(config)


@pytest.fixture(scope="module")
def poses(recordings):
    """Kind -> recording -> pose of the camera in the first frame of every episode."""
    return {kind: [first_poses(folder, CAMERAS[kind]) for folder in folders] for kind, folders in recordings.items()}


def first_poses(folder, camera):
    """Pose of the camera in the first frame of every episode."""
    source = SourceDataset(folder)
    key = keys.world_from_cam(camera)
    tables = [EpisodeTables(source, source.data_file(i), [key]).read(i) for i in range(len(source.episodes))]
    return [table[key][0].as_py() for table in tables]


@pytest.fixture
def edit(monkeypatch, tmp_path):
    """A function that runs LeRobot's command on two datasets of a kind and returns the result's folder."""

    def run(operation, folders):
        target = tmp_path / f"{operation} {len(list(tmp_path.iterdir()))}"
        flags = [f"--operation.type={operation}", *OPERATIONS[operation], "--repo_id=test/a"]
        if operation == "merge":
            flags += ["--operation.repo_ids=['test/a', 'test/b']", f"--operation.roots={[str(f) for f in folders]}"]
        elif operation == "remove_feature":
            removed = [key for key in read_info(folders[0])["features"] if key.endswith(("_depth", "_height"))]
            flags += [f"--operation.feature_names={removed}"]
        if operation == "modify_tasks":
            flags += [f"--root={shutil.copytree(folders[0], target)}"]  # in place
        else:
            flags += [f"--root={folders[0]}", f"--new_root={target}", "--new_repo_id=test/edited"]
        monkeypatch.setattr(sys, "argv", ["lerobot-edit-dataset", *flags])
        edit_dataset()
        return target / "train" if operation == "split" else target

    return run


def is_possible(operation, kind):
    """LeRobot converts datasets without videos only, and re-encodes those with videos."""
    return operation != ("convert_image_to_video" if kind == "video" else "reencode_videos")


@pytest.mark.parametrize(
    ("operation", "kind"),
    [(operation, kind) for kind in CAMERAS for operation in OPERATIONS if is_possible(operation, kind)],
)
def test_an_edited_dataset_is_read_and_gets_views(operation, kind, recordings, poses, edit, tmp_path):
    source, camera = recordings[kind][0], CAMERAS[kind]
    edited = edit(operation, recordings[kind])

    dataset = LeRobotDataset("test/edited", root=edited, video_backend="pyav")
    episodes = EPISODES.get(operation, [(0, 0), (0, 1)])
    assert dataset[len(dataset) - 1]["episode_index"] == len(episodes) - 1
    assert first_poses(edited, camera) == [poses[kind][day][episode] for day, episode in episodes]
    features, declared = dataset.meta.features, read_info(source)["features"]
    kept = [key for key in declared if key in features and "info" in declared[key]]
    assert kept
    for key in kept:
        assert features[key]["info"].get("symview") == declared[key]["info"].get("symview"), key
    write_card(edited, "test/edited", [])

    config = views_config(edited, tmp_path / "views", camera=camera, views=["persp"], size=16)
    made = add_views(config)
    assert stored_workspace(read_info(made)["features"]) == WORKSPACE
    assert first_poses(made, camera) == first_poses(edited, camera)


def test_views_are_added_before_or_after_a_merge(recordings, edit, tmp_path):
    before = SourceDataset(edit("merge", recordings["viewed"]))
    merged = edit("merge", recordings["recorded"])
    after = SourceDataset(add_views(views_config(merged, tmp_path / "views", views=["reproj"])))
    assert before.features == after.features
    key = keys.view("side", "reproj")
    for episode in range(4):
        images = [
            EpisodeTables(source, source.data_file(episode), [key]).read(episode)[key].to_pylist()
            for source in (before, after)
        ]
        assert [image["bytes"] for image in images[0]] == [image["bytes"] for image in images[1]]


def test_recordings_of_different_workspaces_do_not_merge(recordings, edit, tmp_path):
    """States are relative to the workspace's centre, and views show it."""
    first, second = recordings["recorded"]
    moved = shutil.copytree(second, tmp_path / "moved")
    meaning = {"workspace": plain(asdict(Workspace(size=0.5)))}
    change_feature(moved, keys.rgb("side"), info={"symview": meaning})
    with pytest.raises(ValueError, match="Same features is expected"):
        edit("merge", [first, moved])
    other = views_config(second, tmp_path / "other", views=["reproj"], workspace=Workspace(size=0.5))
    with pytest.raises(ValueError, match="Same features is expected"):
        edit("merge", [recordings["viewed"][0], add_views(other)])


@pytest.mark.parametrize(
    ("operation", "kind", "options"),
    [
        ("merge", "recorded", []),
        ("merge", "video", []),
        ("merge", "viewed", []),
        ("merge", "calibrated", JOINTS),
        ("delete_episodes", "calibrated", JOINTS),
        ("convert_image_to_video", "viewed", [NO_IMAGE_STATISTICS]),
    ],
)
def test_a_policy_trains_on_an_edited_dataset(operation, kind, options, recordings, poses, edit, tmp_path, monkeypatch):
    """Its checkpoint renders views without the observation's calibration, unless the camera was moved."""
    edited = edit(operation, recordings[kind])
    checkpoint = train(monkeypatch, edited, tmp_path / "policy", "--dataset.video_backend=pyav", *options)
    config = PreTrainedConfig.from_pretrained(checkpoint)
    assert config.workspace == plain(asdict(WORKSPACE))
    if operation == "merge":
        assert config.calibration == {}
        return
    camera = CAMERAS[kind]
    stored = parse_calibration(config.calibration).camera(camera)
    assert stored.world_from_cam.ravel().tolist() == poses[kind][0][0]
    images = {
        keys.rgb(camera): torch.rand(3, stored.height, stored.width),
        keys.depth(camera): torch.from_numpy(plane_depth(stored)).float()[None],
        keys.STATE: torch.zeros(config.input_features[keys.STATE].shape),
    }
    matrices = {keys.intrinsics(camera): stored.intrinsics, keys.world_from_cam(camera): stored.world_from_cam}
    matrices = {key: torch.from_numpy(matrix).float().flatten() for key, matrix in matrices.items()}
    preprocessor, _ = make_pre_post_processors(config, pretrained_path=str(checkpoint))
    view = keys.view(camera, "reproj")
    assert torch.equal(preprocessor(dict(images))[view], preprocessor(images | matrices)[view])


def test_demonstrations_of_several_robots_are_checked_by_their_workspace(recordings, edit):
    env = EnvSettings(camera=SIDE, workspace=WORKSPACE)
    kuka = LeRobotDataset("test/b", root=recordings["recorded"][1])
    with pytest.raises(ValueError, match=r"--env\.robot is 'panda', the dataset has 'kuka'; --env\.camera\.fov_deg is"):
        check_scene(kuka, env, "side")
    both = LeRobotDataset("test/edited", root=edit("merge", recordings["recorded"]))
    check_scene(both, env, "side")
    with pytest.raises(ValueError, match=r"--env\.workspace\.size is 0\.4, the dataset has 0\.36"):
        check_scene(both, replace(env, workspace=Workspace()), "side")


def test_datasets_of_the_previous_version_are_read(recordings, tmp_path):
    """They hold the settings of the recording in every image's features, and the calibration in every view's."""
    old = shutil.copytree(recordings["viewed"][0], tmp_path / "old")
    settings = {"task": "block_picking", "robot": "panda", "seed": 0, "placement": asdict(SIDE), "symview": "0.1.0"}
    for key, feature in read_info(old)["features"].items():
        if "info" in feature:
            change_feature(old, key, info={**feature["info"], "symview": feature["info"]["symview"] | settings})
    check_scene(LeRobotDataset("test/old", root=old), EnvSettings(camera=SIDE, workspace=WORKSPACE), "side")
    write_card(old, "test/old", [])
    made = add_views(views_config(old, tmp_path / "views", views=["persp"]))
    features = LeRobotDataset("test/views", root=made).meta.features
    assert stored_workspace(features) == WORKSPACE
    config = make_config()
    config.set_dataset_feature_metadata(features)
    assert (config.view.options["size"], config.workspace) == (VIEW_SIZE, plain(asdict(WORKSPACE)))
