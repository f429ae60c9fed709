"""`--calibration` of commands: one file or several, the dataset's image size and workspace, and flags of the pose."""

import sys

import numpy as np
import pytest

from lerobot_symview import keys
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.calibration.readings import PoseReading, ReadingError
from lerobot_symview.datasets import add_views
from lerobot_symview.datasets.add_views import calibration_and_workspace
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import orbit_pose
from lerobot_symview.geometry.workspace import Workspace
from tests.lerobot_symview.calibration.formats import files


@pytest.mark.parametrize(
    "shape", [(files.HEIGHT, files.WIDTH, 3), (3, files.HEIGHT, files.WIDTH)], ids=["channels last", "channels first"]
)
def test_files_without_an_image_size_take_that_of_the_dataset(tmp_path, shape):
    matrix, pose = tmp_path / "k.txt", tmp_path / "pose.txt"
    matrix.write_text(files.savetxt(files.K))
    pose.write_text(files.savetxt(files.CAMERA_FROM_BASE))
    features = {keys.rgb("front"): {"dtype": "image", "shape": shape}}
    calibration, workspace = calibration_and_workspace(
        [matrix, pose], files.WORKSPACE, features, "front", PoseReading()
    )
    camera = calibration.camera("front")
    assert (camera.height, camera.width) == (files.HEIGHT, files.WIDTH)
    np.testing.assert_allclose(camera.world_from_cam, files.BASE_FROM_CAMERA, atol=1e-6)
    assert workspace == files.WORKSPACE


def test_a_pose_with_several_readings_names_the_flags_that_decide(tmp_path):
    info, pose = tmp_path / "info.yaml", tmp_path / "pose.txt"
    info.write_text(files.camera_info(distortion_coefficients=files.matrix([[0.0] * 5])))
    pose.write_text(files.savetxt(orbit_pose(np.pi / 2, 0.0, 0.8, [0.02, 0.01, 0])))
    arguments = [info, pose], Workspace((0, 0), 0.2), {}, "front"
    with pytest.raises(ReadingError, match=r"^--calibration: .*pose\.txt: .* --pose_direction, .*--pose\.unit decide"):
        calibration_and_workspace(*arguments, PoseReading())
    calibration, _ = calibration_and_workspace(*arguments, PoseReading(direction="camera_to_base"))
    np.testing.assert_allclose(calibration.camera("front").position, [0.02, 0.01, 0.8], atol=1e-6)


@pytest.mark.parametrize(
    ("flags", "expected", "reading"),
    [
        (["--calibration=one.yaml"], "one.yaml", PoseReading()),
        (["--calibration=[k.yaml, pose.yaml]"], "k.yaml pose.yaml", PoseReading()),
        (
            ["--calibration=k.yaml", "--pose_direction=base_to_camera", "--camera_axes=opengl"],
            "k.yaml",
            PoseReading("base_to_camera", camera_axes="opengl"),
        ),
    ],
)
def test_one_file_or_several_and_short_flags_are_accepted(monkeypatch, flags, expected, reading):
    seen = []
    monkeypatch.setattr(add_views, "add_views", seen.append)
    monkeypatch.setattr(sys, "argv", ["symview-add-views", "--dataset.repo_id=me/real", *flags])
    with pytest.raises(SystemExit) as end:
        add_views.main()
    assert not end.value.code
    (config,) = seen
    given = config.calibration if isinstance(config.calibration, list) else [config.calibration]
    assert " ".join(map(str, given)) == expected
    assert config.pose == reading


def test_an_unknown_reading_is_an_error_of_its_flag(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["symview-add-views", "--dataset.repo_id=me/real", "--pose_direction=up"])
    with pytest.raises(SystemExit) as end:
        add_views.main()
    assert end.value.code == 2
    assert "direction must be one of camera_to_base, base_to_camera, got 'up'" in capsys.readouterr().err


def test_python_objects_in_an_array_are_refused(tmp_path):
    (tmp_path / "file").write_bytes(files.save(np.array([{}], dtype=object)))
    with pytest.raises(CalibrationError, match=r"cannot read .*file: Object arrays cannot be loaded"):
        read_calibration(tmp_path / "file")
