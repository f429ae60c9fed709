"""Arms with joints: models from URDF and MJCF, forward and inverse kinematics, and what a robot's numbers mean."""

from lerobot_symview.kinematics.arm import Arm, arm_from_plain
from lerobot_symview.kinematics.chain import FrameTree, arm_chain
from lerobot_symview.kinematics.inverse import Solution, solve
from lerobot_symview.kinematics.mjcf import read_mjcf
from lerobot_symview.kinematics.model import ArmModel, Joint, model_from_plain
from lerobot_symview.kinematics.units import check_positions, joint_scales
from lerobot_symview.kinematics.urdf import read_urdf

__all__ = [
    "Arm",
    "ArmModel",
    "FrameTree",
    "Joint",
    "Solution",
    "arm_chain",
    "arm_from_plain",
    "check_positions",
    "joint_scales",
    "model_from_plain",
    "read_mjcf",
    "read_urdf",
    "solve",
]
