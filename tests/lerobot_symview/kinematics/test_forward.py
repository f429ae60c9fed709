"""Forward kinematics against the models' own simulators, and models that are refused."""

import numpy as np
import pytest

from lerobot_symview.errors import KinematicsError
from lerobot_symview.kinematics import ArmModel, arm_chain, model_from_plain, read_mjcf, read_urdf
from tests.helpers.arms import (
    PANDA,
    SO101,
    SO101_MJCF,
    TOOL_OFFSET,
    bullet_places,
    mujoco_places,
    panda,
    random_positions,
    so101,
)

TENTH_OF_A_MILLIMETRE = 1e-4


def angle_between(first, second):
    return np.arccos(np.clip((np.einsum("nij,nij->n", first, second) - 1) / 2, -1, 1))


def so101_mjcf():
    return arm_chain(read_mjcf(SO101_MJCF), "gripperframe", "x", gripper="gripper", tool_offset=TOOL_OFFSET)


@pytest.mark.parametrize("make", [so101, so101_mjcf])
def test_the_so101_is_where_mujoco_has_it(make):
    positions = random_positions(make(), 300)
    places, matrices = mujoco_places(positions)
    found = make().forward(positions)
    np.testing.assert_allclose(found[:, :3, 3], places, atol=TENTH_OF_A_MILLIMETRE)
    axes = np.stack([matrices[:, :, 2], -matrices[:, :, 1], matrices[:, :, 0]], axis=2)  # the site points along its x
    assert np.rad2deg(angle_between(found[:, :3, :3], axes)).max() < 0.1


def test_the_mjcf_agrees_with_mujoco_to_rounding():
    positions = random_positions(so101_mjcf(), 50)
    np.testing.assert_allclose(so101_mjcf().forward(positions)[:, :3, 3], mujoco_places(positions)[0], atol=1e-9)


def test_the_panda_is_where_pybullet_has_it():
    positions = random_positions(panda(), 300)
    places, matrices = bullet_places(positions)
    found = panda().forward(positions)
    np.testing.assert_allclose(found[:, :3, 3], places, atol=TENTH_OF_A_MILLIMETRE)
    tool = np.stack([matrices[:, :, 1], -matrices[:, :, 0], matrices[:, :, 2]], axis=2)  # the fingers open along y
    np.testing.assert_allclose(found[:, :3, :3], tool, atol=1e-4)


def test_a_stored_chain_is_the_same_chain():
    for model in (so101(), panda()):
        positions = random_positions(model, 5)
        again = model_from_plain(model.plain())
        np.testing.assert_array_equal(again.forward(positions), model.forward(positions))
        np.testing.assert_array_equal(again.lower, model.lower)
        assert again.names == model.names


GANTRY = """<robot name="gantry">
  <joint name="lift" type="prismatic"><parent link="base"/><child link="a"/><origin xyz="0 0 1" rpy="0 0 1.5707963"/>
    <axis xyz="0 0 -2"/><limit lower="0" upper="0.5"/></joint>
  {joints}
  <joint name="tip" type="fixed"><parent link="e"/><child link="tool"/></joint>
</robot>"""
TURNS = [f'<joint name="j{i}" type="continuous"><parent link="{p}"/><child link="{c}"/></joint>'
         for i, (p, c) in enumerate(["ab", "bc", "cd", "de"])]  # fmt: skip


def written(folder, text):
    file = folder / "arm.urdf"
    file.write_text(text)
    return file


def test_prismatic_and_continuous_joints_and_axes_of_any_length(tmp_path):
    tree = read_urdf(written(tmp_path, GANTRY.format(joints="".join(TURNS))))
    model = arm_chain(tree, "tool", opening="x")
    assert model.upper.tolist() == [0.5, np.inf, np.inf, np.inf, np.inf]
    down = model.forward(np.array([[0.3, 0, 0, 0, 0]]))[0]
    np.testing.assert_allclose(down[:3, 3], [0, 0, 0.7], atol=1e-9)
    np.testing.assert_allclose(down[:3, 0], [0, 1, 0], atol=1e-6)
    assert model_from_plain(model.plain()).upper[1] == np.inf


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "is no XML"),
        ("<mujoco/>", "no URDF, its root is <mujoco>: it is MJCF"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><robot/>", "declares entities"),
        ("<robot/>", "has no joints"),
        (GANTRY.format(joints=""), "unknown frame|an arm needs 5 to 16 joints"),
        (GANTRY.format(joints="".join(TURNS)).replace("continuous", "planar"), "type 'planar', expected one of fixed"),
        (GANTRY.format(joints="".join(TURNS)).replace("0 0 -2", "0 0 0"), r"axis of the joint 'lift' is \[0.0, 0.0"),
        (GANTRY.format(joints="".join(TURNS)).replace("0 0 -2", "0 1"), "has '0 1' where three numbers belong"),
        (GANTRY.format(joints="".join(TURNS)).replace("0.5", "-1"), "'lift' has limits from 0.0 to -1.0"),
        (GANTRY.format(joints="".join(TURNS)).replace('0 0 1"', '0 0 nan"'), "'lift' has a pose.*not finite"),
        (
            GANTRY.format(joints="".join(TURNS)).replace("</joint>", '<mimic joint="x"/></joint>', 1),
            "the joint 'lift' mimics 'x'",
        ),
        (GANTRY.format(joints="".join(TURNS)).replace('"base"', '"tool"'), "no tree"),
    ],
)
def test_a_wrong_urdf_is_refused_in_words(tmp_path, text, message):
    with pytest.raises(KinematicsError, match=message):
        arm_chain(read_urdf(written(tmp_path, text)), "tool", opening="x")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tool_frame": "gripper_frame"}, "unknown frame of the model 'gripper_frame'.*mean 'gripper_frame_link'"),
        ({"tool_frame": "shoulder_link"}, "5 to 16 joints.*got 1: shoulder_pan"),
        ({"approach": "up"}, "approach must be one of x, y, z"),
        ({"opening": "up"}, "opening must be one of x, y, z"),
        ({"opening": "-z"}, "fingers would open in the direction in which they point"),
        ({"gripper": "jaw"}, "no joint 'jaw'.*it has gripper, wrist_roll"),
        ({"gripper": "wrist_roll"}, "'wrist_roll' must move a finger"),
    ],
)
def test_wrong_names_are_refused_in_words(options, message):
    with pytest.raises(KinematicsError, match=message):
        arm_chain(read_urdf(SO101), **({"tool_frame": "gripper_frame_link", "gripper": "gripper"} | options))


def test_a_model_that_mujoco_cannot_read_is_refused(tmp_path):
    for file in (tmp_path / "none.xml", written(tmp_path, "<mujoco><no/></mujoco>")):
        with pytest.raises(KinematicsError, match=str(file)):
            read_mjcf(file)


@pytest.mark.parametrize("change", [{"joints": 3}, {"last_from_tool": [1]}, {"joints": []}])
def test_a_malformed_stored_chain_is_refused(change):
    with pytest.raises(KinematicsError):
        model_from_plain(so101().plain() | change)
    stored = so101().plain()
    stored["joints"][0]["kind"] = "ball"
    with pytest.raises(KinematicsError, match="revolute or prismatic, got 'ball'"):
        model_from_plain(stored)


def test_the_joints_of_a_panda_are_those_of_its_arm():
    assert panda().names == [f"panda_joint{index}" for index in range(1, 8)]
    assert isinstance(panda(), ArmModel)
    assert PANDA.is_file()
