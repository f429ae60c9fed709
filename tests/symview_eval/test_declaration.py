"""What the preview says about the declared types, by numbers and by images, of demonstrations right and wrong."""

import re
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_policy_symview.symmetry.groups import make_group
from lerobot_symview import keys
from lerobot_symview.datasets.convert_actions import ConvertActionsConfig, convert_actions
from lerobot_symview.datasets.features import stored_workspace
from lerobot_symview.datasets.frame_reader import FrameReader
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.datasets.robot_flags import RobotFlags
from lerobot_symview.datasets.source import SourceDataset, vectors
from lerobot_symview.geometry.camera import project
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.runtime.cli import DatasetLocation
from symview_eval.declaration import check_declaration
from symview_eval.declaration_words import described, nearest_element
from symview_eval.motion_check import MotionScores, motion_scores
from symview_eval.preview import PreviewConfig, preview
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset
from tests.helpers.arms import CAMERAS, record_arm
from tests.helpers.cameras import make_camera
from tests.helpers.datasets import change_feature

D4 = make_group("D4")
WORKSPACE = Workspace((0.45, 0.0), 0.4)
TYPES = ["x", "y", "z", "yaw", "aperture"]


def filmed(element, seed, frames=30):
    """Images of a dot that goes around, and the state's path, to which a group element must be applied to fit them."""
    rng = np.random.default_rng(seed)
    camera = make_camera()
    seen = np.cumsum(rng.normal(0, 0.03, (frames, 3)), axis=0) * [1, 1, 0] + [*rng.uniform(-0.1, 0.1, 2), 0.05]
    images = rng.integers(100, 110, (frames, camera.height, camera.width, 3), dtype=np.uint8)
    for image, pixel in zip(images, project(seen + [*WORKSPACE.center, 0], camera)[0].round().astype(int), strict=True):
        row, column = pixel[::-1].clip(3, 1000)
        image[row - 3 : row + 4, column - 3 : column + 4] = 255
    path = seen.copy()
    path[:, :2] = seen[:, :2] @ D4.rotation()[element]  # of the inverse
    return images, path + [*WORKSPACE.center, 0], camera


@pytest.mark.parametrize("element", range(D4.size))
def test_the_images_tell_how_the_path_must_be_transformed(element):
    scores = [motion_scores(*filmed(element, seed), WORKSPACE, D4) for seed in range(4)]
    assert MotionScores(np.array(scores), D4).best() == element


def test_images_without_the_gripper_tell_nothing():
    scores = []
    for seed in range(6):
        _, points, camera = filmed(0, seed)
        noise = np.random.default_rng(seed).integers(256, size=(30, camera.height, camera.width, 3), dtype=np.uint8)
        scores.append(motion_scores(noise, points, camera, WORKSPACE, D4))
    assert MotionScores(np.array(scores), D4).best() is None
    assert motion_scores(np.zeros_like(noise), points, camera, WORKSPACE, D4) is None


@pytest.mark.parametrize("element", range(D4.size))
@pytest.mark.parametrize("units", [1.0, 1000.0])
def test_the_likeliest_transform_is_named(element, units):
    assert nearest_element(D4.rotation()[element] @ np.diag([0.3, 0.4 * units]), D4) == element


def test_every_transform_has_a_name_of_its_own():
    for name in ("D4", "C8", "D8"):
        group = make_group(name)
        assert len({described(group, element) for element in range(group.size)}) == group.size


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """A converted recording of joints, whose images are noise."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "cameras.yaml").write_text(CAMERAS)
    source = HubDataset("test/arm", record_arm(folder / "arm", 8, 40))
    return convert_actions(
        ConvertActionsConfig(
            source, RobotFlags(preset="so101"), new_root=folder / "ee", calibration=folder / "cameras.yaml"
        )
    )


@pytest.fixture(scope="module")
def pushing(tmp_path_factory):
    """Demonstrations in the simulator with the manner of people, seen by a small camera."""
    camera = CameraSpec(height=48, width=64)
    env = RecordedEnv(task="block_pushing", control="fine", style="human", oracle=False, camera=camera)
    folder = tmp_path_factory.mktemp("pushing") / "data"
    return generate(GenerateConfig(NewDataset("test/pushing", folder), env, num_episodes=6))


def changed(source, folder, change, **entries):
    """Copy a dataset; `change` maps its states and actions (N, D). Entries change the action's declaration."""
    shutil.copytree(source, folder)
    for file in sorted((folder / "data").rglob("*.parquet")):
        table = pq.read_table(file)
        for key, values in zip((keys.STATE, keys.ACTION), change(*_values(table)), strict=True):
            column = table.schema.get_field_index(key)
            cells = pa.array(values.astype(np.float32).tolist(), table.field(column).type)
            table = table.set_column(column, table.field(column), cells)
        pq.write_table(table, file)
    if entries:
        change_feature(folder, keys.ACTION, **entries)
    return folder


def _values(table):
    return [vectors(table, key).astype(np.float64) for key in (keys.STATE, keys.ACTION)]


def report_of(folder, camera, **types):
    source = SourceDataset(folder)
    return check_declaration(source, FrameReader(source, camera, stored_workspace(source.features), []), **types)


def permuted(*order):
    return lambda state, action: (state, action[:, list(order)])


def scaled(*factors):
    return lambda state, action: (state, action * np.array(factors))


def as_targets(state, action):
    return state, action + np.pad(state[:, [0, 1, 2, 3]], ((0, 0), (0, action.shape[1] - 4)))


def turned(state, action):
    """States and actions of a base that is turned by 90 degrees against the calibration."""
    for values in (state, action):
        values[:, :2] = np.stack([-values[:, 1], values[:, 0]], axis=1)
    return state, action


def test_a_converted_recording_is_not_contradicted(arm):
    report = report_of(arm, "front")
    assert report.warnings == []
    assert [fact.split(":")[0] for fact in report.facts] == [
        *("x, y", "z", "yaw", "aperture", "scalar"),
        "the images do not say whether the gripper is where the state says",
    ]


FAULTS = {
    "x and y swapped": (
        permuted(1, 0, 2, 3, 4, 5),
        r"declaration of x and y .*as if the action were with x and y swap",
    ),
    "x negated": (scaled(-1, 1, 1, 1, 1, 1), r"of x and y .*as if the action were with x negated"),
    "y negated": (scaled(1, -1, 1, 1, 1, 1), r"of x and y .*as if the action were with y negated"),
    "x and z swapped": (permuted(2, 1, 0, 3, 4, 5), r"of z .*follows the action's '[xy]', dimension"),
    "z and yaw swapped": (permuted(0, 1, 3, 2, 4, 5), r"of yaw .*follows the action's 'z', dimension 2"),
    "yaw negated": (scaled(1, 1, 1, -1, 1, 1), r"the action's yaw moves the state's yaw the other way"),
    "z in millimetres": (scaled(1, 1, 1000, 1, 1, 1), r"one unit of the action's z moves .*their units differ"),
    "yaw in degrees": (scaled(1, 1, 1, 57.3, 1, 1), r"one unit of the action's yaw moves .*0.017 times as far as x"),
    "x in millimetres": (scaled(1000, 1, 1, 1, 1, 1), r"of x and y .*along the one axis and by .* along the other"),
    "targets": (as_targets, "the actions are targets of the position, not increments"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_the_actions_is_named(arm, tmp_path, fault):
    change, message = FAULTS[fault]
    warnings = report_of(changed(arm, tmp_path / "wrong", change), "front").warnings
    assert any(re.search(message, warning) for warning in warnings), warnings


def test_declared_types_take_the_place_of_names(arm, tmp_path):
    unnamed = changed(arm, tmp_path / "unnamed", permuted(0, 1, 2, 3, 4, 5), names=[f"a{i}" for i in range(6)])
    assert report_of(unnamed, "front").facts[0].startswith("not checked: the names of states and actions are no types")
    right = [*TYPES, "scalar"]
    assert report_of(unnamed, "front", action_types=right).warnings == []
    (warning,) = report_of(unnamed, "front", action_types=["y", "x", *right[2:]]).warnings
    assert "--action_symmetry" in warning
    with pytest.raises(ValueError, match="--action_symmetry describes 5 dimensions"):
        report_of(unnamed, "front", action_types=TYPES)
    with pytest.raises(ValueError, match="--state_symmetry declares 'x' as 'y'"):
        report_of(unnamed, "front", state_types=["y", "x", *right[2:]], action_types=right)


def test_a_state_without_names_is_declared(arm, tmp_path):
    unnamed = changed(arm, tmp_path / "unnamed", permuted(0, 1, 2, 3, 4, 5))
    change_feature(unnamed, keys.STATE, names=None)
    report = report_of(unnamed, "front", state_types=[*TYPES, "scalar"])
    assert report.warnings == []
    assert report.facts[0].startswith("x, y: the actions explain")


def test_the_images_of_long_videos_are_checked(tmp_path):
    (tmp_path / "cameras.yaml").write_text(CAMERAS)
    source = HubDataset("test/arm", record_arm(tmp_path / "arm", 3, 160, use_videos=True))
    arm = RobotFlags(preset="so101")
    options = {"new_root": tmp_path / "ee", "calibration": tmp_path / "cameras.yaml"}
    report = report_of(convert_actions(ConvertActionsConfig(source, arm, **options)), "front")
    assert report.facts[-1] == "the images do not say whether the gripper is where the state says"  # they are noise


def test_an_episode_that_is_not_finite_is_left_out_with_a_warning(arm, tmp_path):
    def broken(state, action):
        action[3, 0] = np.nan
        return state, action

    report = report_of(changed(arm, tmp_path / "nan", broken), "front")
    assert "a state or an action of episode 0 is not finite: the check leaves it out" in report.warnings
    assert report.facts[0].startswith("x, y: the actions explain")


def test_too_few_episodes_are_not_checked(recorded):
    assert "not checked: 2 episodes, expected at least 3" in report_of(recorded, "side").facts


@pytest.mark.slow
def test_simulated_demonstrations_pass_and_a_turned_base_is_seen(pushing, tmp_path):
    """States and actions of a turned base are consistent; only the images contradict them."""
    report = report_of(pushing, "side")
    assert report.warnings == []
    assert report.facts[-1].startswith("the images of 6 episodes change where the state says that the gripper is")
    (warning,) = report_of(changed(pushing, tmp_path / "turned", turned), "side").warnings
    assert "if the state were rotated by 270 degrees" in warning


def test_the_preview_shows_and_warns(arm, tmp_path, caplog):
    folder = changed(arm, tmp_path / "wrong", scaled(-1, 1, 1, 1, 1, 1))
    config = PreviewConfig(
        DatasetLocation("test/ee", folder), camera="front", frames=1, rerun=False, output_dir=tmp_path / "preview"
    )
    page = (preview(config) / "preview.html").read_text()
    assert re.search(r"<li>z: the actions explain \d+% of the motion", page)
    assert "the demonstrations contradict the declaration of x and y" in page
    assert "the demonstrations contradict the declaration of x and y" in caplog.text
