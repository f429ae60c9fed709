"""The gripper's path is drawn where the gripper is, so that a wrong base or unit is seen."""

import numpy as np
import pytest

from lerobot_symview import keys
from lerobot_symview.datasets.convert_actions import ConvertActionsConfig, convert_actions
from lerobot_symview.datasets.frame_reader import FrameReader
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.datasets.robot_flags import RobotFlags
from lerobot_symview.datasets.source import EpisodeTables, SourceDataset, vectors
from lerobot_symview.geometry.camera import project
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import DatasetLocation
from symview_eval.gripper_path import HERE, PATH, GripperPath, read_path
from symview_eval.preview import PreviewConfig, preview
from tests.helpers.arms import CAMERAS, record_arm
from tests.helpers.cameras import make_camera

WORKSPACE = Workspace((0.45, 0.0), 0.4)


def pixels_of(image, color):
    return np.argwhere((image == color).all(axis=-1)).mean(axis=0)


def test_the_path_lies_on_the_view_where_the_gripper_was():
    """Rows grow with x, columns with y."""
    points = np.array([[0.35, -0.1, 0.1], [0.35, 0.1, 0.1]])
    drawn = GripperPath(points, WORKSPACE).on_view(np.zeros((100, 100, 3), np.uint8), 1)
    scale = len(drawn) / 100
    np.testing.assert_allclose(pixels_of(drawn, HERE) / scale, [25, 75], atol=1)
    np.testing.assert_allclose(pixels_of(drawn, PATH) / scale, [25, 48], atol=3)


def test_the_gripper_is_drawn_where_the_camera_sees_it():
    camera = make_camera()
    points = np.array([[0.4, -0.05, 0.08], [0.5, 0.05, 0.04]])
    image = GripperPath(points, WORKSPACE).in_camera(np.zeros((camera.height, camera.width, 3), np.uint8), camera, 1)
    middle, _ = project(np.array([[0.5, 0.05, 0.02]]), camera)  # of the line from the table to the gripper
    np.testing.assert_allclose(pixels_of(image, HERE)[::-1], middle[0], atol=2)


@pytest.fixture(scope="module")
def converted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm")
    (folder / "cameras.yaml").write_text(CAMERAS)
    source = HubDataset("test/arm", record_arm(folder / "arm", 1, 20))
    return convert_actions(
        ConvertActionsConfig(
            source, RobotFlags(preset="so101"), new_root=folder / "ee", calibration=folder / "cameras.yaml"
        )
    )


def test_the_preview_of_a_converted_dataset_shows_the_path(converted, tmp_path, caplog):
    config = PreviewConfig(
        DatasetLocation("test/ee", converted), camera="front", frames=2, rerun=False, output_dir=tmp_path
    )
    page = (preview(config) / "preview.html").read_text()
    assert page.count("<figcaption>the gripper&#39;s path</figcaption>") == 2
    assert "not over the workspace" not in caplog.text


def test_positions_are_those_of_the_state_in_the_world(converted):
    source = SourceDataset(converted)
    workspace = Workspace((0.25, 0.0), 0.3)
    path = read_path(FrameReader(source, "front", workspace, []), 0)
    state = vectors(EpisodeTables(source, source.data_file(0), [keys.STATE]).read(0), keys.STATE)
    np.testing.assert_allclose(path.points, state[:, :3] + [0.25, 0, 0], atol=1e-7)


def test_a_gripper_beside_the_workspace_is_reported(converted, caplog):
    far = FrameReader(SourceDataset(converted), "front", Workspace((0.25, 0.0), 0.01), [])
    assert read_path(far, 0).outside > 0.9
    assert "of episode 0 the gripper is not over the workspace" in caplog.text


def test_without_positions_there_is_no_path(converted):
    record = FrameReader(SourceDataset(converted.parent / "arm"), "front", WORKSPACE, [])
    assert read_path(record, 0) is None
