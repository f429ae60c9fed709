"""Robot arms with parallel grippers, as data. Importing it does not import PyBullet."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class RobotSpec:
    """The parameters of one robot model.

    Args:
        model: URDF or SDF file of `pybullet_data`.
        base: position of the model's origin, world frame, metres.
        home: initial joint angles of the inverse kinematics, rad.
        hand_link: last link of the arm; its z axis is the approach direction of the gripper.
        finger_links: gripping links of each finger.
        gripper_joints: the other joints by index: position when closed, position when open (metres or rad) and motor
            limit (N or N m).
        finger_yaw: angle from the fingers' opening axis to the hand frame's x axis, rad.
        arm_force: motor limit of an arm joint, N m.
        hand_from_tool: (3,) point between the fingertips in the hand's frame, metres.
        joint_limits: by joint: lower and upper limits that replace the model's, rad.
        color: RGBA of the arm; the gripper is drawn in `finger_color`.
    """

    model: str
    base: tuple[float, float, float]
    home: tuple[float, ...]
    hand_link: int
    finger_links: tuple[tuple[int, ...], tuple[int, ...]]
    gripper_joints: dict[int, tuple[float, float, float]]
    finger_yaw: float
    arm_force: float
    hand_from_tool: tuple[float, float, float] = (0.0, 0.0, 0.0)
    joint_limits: dict[int, tuple[float, float]] = field(default_factory=dict)
    color: tuple[float, float, float, float] = (0.93, 0.93, 0.95, 1.0)
    finger_color: tuple[float, float, float, float] = (0.25, 0.25, 0.28, 1.0)


ROBOTS = {
    "panda": RobotSpec(
        model="franka_panda/panda.urdf",
        base=(-0.1, 0.0, 0.0),
        home=(0.0, 0.1, 0.0, -2.2, 0.0, 2.3, 0.785),
        hand_link=6,  # includes the hand, which is fixed to it
        finger_links=((7,), (8,)),
        gripper_joints=dict.fromkeys((7, 8), (0.0, 0.04, 10.0)),
        finger_yaw=np.pi / 4,
        arm_force=240.0,
        hand_from_tool=(0.0, 0.0, 0.212),
    ),
    "kuka": RobotSpec(
        model="kuka_iiwa/kuka_with_gripper2.sdf",
        base=(-0.1, 0.0, 0.0),
        home=(0.0, 0.6, 0.0, -1.6, 0.0, 0.95, 0.0),
        hand_link=6,
        finger_links=((9, 10), (12, 13)),
        # Joint 7 connects the arm and the gripper. The tips (10, 13) are parallel when open and when closed on 5 cm.
        gripper_joints={
            7: (0.0, 0.0, 100.0),
            8: (0.045, -0.195, 2.5),
            10: (-0.078, 0.025, 2.0),
            11: (-0.045, 0.195, 2.5),
            13: (0.078, -0.025, 2.0),
        },
        finger_yaw=np.pi,
        arm_force=240.0,
        hand_from_tool=(0.0, 0.022, 0.267),
        joint_limits={
            3: (-2.4, 2.4)
        },  # with the model's 120 degrees the gripper cannot reach the workspace's near edge
    ),
}
