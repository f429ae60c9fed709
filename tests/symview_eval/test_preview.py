import logging

import numpy as np
import pytest

from lerobot_symview.datasets.add_views import add_views
from lerobot_symview.datasets.source import SourceDataset
from lerobot_symview.errors import SymviewError
from lerobot_symview.geometry.camera import Camera, intrinsics_from_fov, orbit_pose
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import DatasetLocation
from lerobot_symview.views import make_view
from symview_eval.contact_sheet import OUTLINE, png_uri, with_outline
from symview_eval.preview import PreviewConfig, preview, read_moments, table_resolution
from tests.helpers.cameras import make_camera
from tests.helpers.datasets import views_config


def config(source, folder, **options):
    return PreviewConfig(DatasetLocation("test/shown", source), output_dir=folder, **({"rerun": False} | options))


def test_views_are_shown_before_they_are_added(recorded, tmp_path):
    page = (preview(config(recorded, tmp_path, episodes=[0, 1], frames=2)) / "preview.html").read_text()
    for name in ("side and workspace", "top", "side_reproj", "side_reproj_height", "side_reproj_seen", "side_persp"):
        assert page.count(f"<figcaption>{name}</figcaption>") == 4
    assert "side_depth" not in page
    assert "episode 1, frame 6" in page
    assert "45° elevation, 0° azimuth, 0.81 m" in page


def test_a_dataset_of_views_alone_is_shown_as_it_is(only_views, tmp_path):
    page = (preview(config(only_views, tmp_path, frames=1)) / "preview.html").read_text()
    assert page.count("<figcaption>") == 2
    assert "<figcaption>side_reproj</figcaption>" in page


def test_views_of_a_dataset_are_shown_as_they_are_stored(with_views, tmp_path, caplog):
    (moment,) = read_moments(SourceDataset(with_views), None, 0, [0])
    with caplog.at_level(logging.WARNING, logger="symview_eval.preview"):
        page = (preview(config(with_views, tmp_path, frames=1)) / "preview.html").read_text()
    assert caplog.text == ""
    for name in ("side_reproj", "side_persp", "side_persp_gripper"):
        assert f'<figcaption>{name}</figcaption><img src="{png_uri(moment.stored[name])}"' in page
    assert "side_reproj_seen" not in page
    assert "<figcaption>side and workspace</figcaption>" in page


@pytest.mark.parametrize("options", [{"views": ["reproj"]}, {"reproj": make_view("reproj", infill="none")}])
def test_views_that_are_asked_for_are_computed_beside_the_stored_ones(with_views, tmp_path, options):
    (moment,) = read_moments(SourceDataset(with_views), None, 0, [0])
    page = (preview(config(with_views, tmp_path, frames=1, **options)) / "preview.html").read_text()
    assert f'<figcaption>side_reproj, stored</figcaption><img src="{png_uri(moment.stored["side_reproj"])}"' in page
    assert page.count("<figcaption>side_reproj, computed</figcaption>") == 1
    assert page.count("<figcaption>side_reproj_seen</figcaption>") == 1
    assert page.count("<figcaption>side_persp</figcaption>") == 1


def test_a_stated_workspace_is_shown_and_measured(recorded, with_views, tmp_path, caplog):
    with caplog.at_level(logging.WARNING, logger="symview_eval.preview"):
        preview(config(recorded, tmp_path / "elsewhere", frames=1, workspace=Workspace((0.45, 0.6))))
    assert "of the workspace, less than 60%: move or turn it" in caplog.text
    stated = config(with_views, tmp_path / "stated", frames=1, workspace=Workspace(size=0.3))
    assert "<figcaption>side_reproj, computed</figcaption>" in (preview(stated) / "preview.html").read_text()


def test_a_view_that_is_not_stored_is_computed(recorded, tmp_path):
    source = add_views(views_config(recorded, tmp_path / "persp", views=["persp"]))
    page = (preview(config(source, tmp_path / "preview", frames=1)) / "preview.html").read_text()
    for name in ("side_persp", "side_reproj", "side_reproj_seen"):
        assert page.count(f"<figcaption>{name}</figcaption>") == 1


def test_what_is_too_little_is_said(recorded, tmp_path, caplog):
    with caplog.at_level(logging.WARNING, logger="symview_eval.preview"):
        preview(config(recorded, tmp_path / "coarse", frames=1))
        assert "of side_reproj is inferred, more than --max_holes=0.5" in caplog.text
        assert "reproj asks for 0.38 px/mm" in caplog.text
        caplog.clear()
        preview(config(recorded, tmp_path / "fine", frames=1, size=40))
        assert caplog.text == ""


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"episodes": [7]}, SymviewError, r"--episodes names \[7\], the dataset has 2 episodes"),
        ({"camera": "front", "views": ["persp"]}, ValueError, "no camera 'front'"),
    ],
)
def test_a_mistake_is_named(recorded, tmp_path, options, error, message):
    with pytest.raises(error, match=message):
        preview(config(recorded, tmp_path, **options))


@pytest.mark.parametrize(("option", "value"), [("frames", 0), ("episodes", []), ("max_holes", 2.0)])
def test_impossible_options_are_refused(option, value):
    with pytest.raises(ValueError, match=f"--{option}"):
        PreviewConfig(DatasetLocation("a/b"), **{option: value})


def test_a_moment_is_read_from_its_row(recorded):
    source = SourceDataset(recorded)
    first, later = read_moments(source, None, 1, [0, 5])
    assert first.title == "episode 1, frame 0"
    assert set(first.stored) == {"side", "side_depth", "top", "top_depth"}
    assert (first.stored["side"] != later.stored["side"]).any()


def test_the_resolution_of_a_camera_straight_above_is_its_focal_length_over_its_height():
    distance, pixels = 0.8, 200
    intrinsics = intrinsics_from_fov(np.deg2rad(50), pixels, pixels)
    camera = Camera(intrinsics, orbit_pose(np.pi / 2, 0.0, distance, (0.45, 0.0, 0.0)), pixels, pixels)
    assert table_resolution(camera, Workspace()) == pytest.approx(intrinsics[0, 0] / distance / 1000, rel=1e-3)


def test_a_lower_camera_resolves_less():
    resolutions = [table_resolution(make_camera(elevation), Workspace()) for elevation in (75, 45, 15)]
    assert resolutions == sorted(resolutions, reverse=True)


def test_the_outline_passes_through_the_corners():
    camera = make_camera(45.0)
    drawn = with_outline(np.zeros((152, 152, 3), dtype=np.uint8), camera, Workspace())
    from lerobot_symview.geometry.camera import project

    scale = drawn.shape[0] // 152
    for u, v in project(Workspace().corners(), camera)[0]:
        column, row = (np.array([u, v]) + 0.5) * scale
        patch = drawn[int(row) - 3 : int(row) + 4, int(column) - 3 : int(column) + 4]
        assert (patch == OUTLINE).all(axis=-1).any()


def test_a_recording_holds_cameras_points_and_views(recorded, tmp_path):
    from rerun.experimental import RrdReader

    preview(config(recorded, tmp_path, frames=2, rerun=True))
    paths = {chunk.entity_path for chunk in RrdReader(tmp_path / "preview.rrd").stream()}
    assert {"/world/side", "/world/side/image", "/world/points", "/world/workspace"} <= paths
    assert {f"/views/side_{name}" for name in ("reproj", "reproj_height", "reproj_seen", "persp")} <= paths


def test_a_recording_holds_points_and_views_that_are_stored(with_views, tmp_path):
    from rerun.experimental import RrdReader

    preview(config(with_views, tmp_path, frames=1, rerun=True))
    paths = {chunk.entity_path for chunk in RrdReader(tmp_path / "preview.rrd").stream()}
    assert {"/world/points", "/views/side_reproj", "/views/side_reproj_height", "/views/side_persp"} <= paths
