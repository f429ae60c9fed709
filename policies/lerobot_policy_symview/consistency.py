"""Whether the options of a policy fit together; errors name the flags to change."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lerobot_policy_symview.symmetry.groups import make_group
from lerobot_symview.registry import check_name
from lerobot_symview.runtime.cli import flagged
from lerobot_symview.views import VIEWS

if TYPE_CHECKING:
    from lerobot_policy_symview.configuration import SymviewConfig

CAMERA_IMAGES = ("side", "top")  # a camera's own image in place of a view
POINT_ENCODERS = ("voxel", "point_cloud")  # lift the camera's image to points in space


def check_view(config: SymviewConfig) -> None:
    """Raise a ValueError or SymviewError if the view is unknown or has wrong options."""
    if config.is_computed:
        check_name("--policy.view", config.view.name, (*CAMERA_IMAGES, *VIEWS))
        if config.view.name in VIEWS.builtin:  # other packages' views are imported when they are made
            with flagged(f"--policy.view={config.view.name}"):
                config.make_view()
    elif config.view.options:
        raise ValueError(f"--policy.view={config.view.name} is a camera's image and has no options: {config.view}")


def check_combination(config: SymviewConfig) -> None:
    """Raise a ValueError if two options contradict each other."""
    if (config.encoder == "plain") != (config.group == "C1"):
        raise ValueError(
            f"--policy.encoder={config.encoder} cannot have --policy.group={config.group}: "
            "only the plain encoder has the group C1"
        )
    if config.encoder in ("relaxed", *POINT_ENCODERS) and not make_group(config.group).is_exact:
        raise ValueError(
            f"--policy.encoder={config.encoder} has filters of single pixels, which rotations by 45 degrees do not "
            f"map onto each other: use --policy.group=D4, got {config.group}"
        )
    if config.sees_points and (config.view.name, config.modality) != ("side", "rgbd"):
        raise ValueError(
            f"--policy.encoder={config.encoder} lifts the camera's own image: use --policy.view=side and "
            f"--policy.modality=rgbd, got {config.view.name} and {config.modality}"
        )
    if config.is_computed and config.modality == "rgbd" and config.height_key is None:
        raise ValueError(f"the view {config.view.name!r} has no height map: use --policy.modality=rgb")
    if config.view.name == "side" and config.gripper_input == "image" and not config.sees_points:
        raise ValueError(
            "--policy.gripper_input=image draws a top-down image of the gripper, which does not fit "
            "--policy.view=side: use --policy.gripper_input=vector, or --policy.method=sideview_equi for both"
        )
    if config.camera_rays and (config.view.name, config.encoder) != ("side", "plain"):
        raise ValueError(
            "--policy.camera_rays=true gives the rays of the camera's own image, which are no scalars: use "
            f"--policy.view=side and --policy.encoder=plain, got {config.view.name} and {config.encoder}"
        )
    if config.gripper_input == "image" and config.missing_of_gripper:
        turning = f", and --policy.action_symmetry={config.action_symmetry} turns it" if config.gripper_turns else ""
        raise ValueError(
            f"--policy.gripper_input=image draws the gripper; --policy.state_symmetry={config.state_symmetry} lacks "
            f"{config.missing_of_gripper}{turning}: use --policy.gripper_input=vector"
        )
    if config.augmentation != "none":
        _check_augmentation(config)
    if config.camera_augmentation > 0 and (config.view.name == "top" or config.remembers):
        raise ValueError(
            "--policy.camera_augmentation changes the images of calibrated cameras, one by one: it is not for "
            "--policy.view=top and for views with memory"
        )


def _check_augmentation(config: SymviewConfig) -> None:
    if config.augmentation == "group" and config.group == "C1":
        raise ValueError(
            "--policy.augmentation=group is the identity with --policy.group=C1: "
            "use --policy.augmentation=d4, so2 or o2"
        )
    turns = config.states.of_type("yaw") or config.gripper_turns
    if turns and (config.gripper_input == "none" or not config.states.of_type("yaw")):
        raise ValueError(
            f"--policy.augmentation={config.augmentation} rotates the gripper with the scene, but its yaw is not an "
            f"input of the network with --policy.gripper_input={config.gripper_input} and --policy.state_symmetry="
            f"{config.state_symmetry}: make a yaw an input, or use --policy.augmentation=none"
        )
