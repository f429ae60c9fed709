"""Configuration of policies that may see several observations and predict several actions at once."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Literal

from lerobot.configs.types import FeatureType, PolicyFeature

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.symmetry.trajectories import Trajectories
from lerobot_symview import keys

MAX_HORIZON = 256


@dataclass
class ChunkConfig(SymviewConfig):
    """A policy whose output is a chunk of actions: the trajectory relative to the gripper's present pose."""

    n_obs_steps: int = 1
    """Observations that the network sees: the present one and those before it."""
    horizon: int = 1
    """Actions that are predicted at once, the first of them for the present observation."""
    n_action_steps: int = 1
    """Actions of a prediction that are carried out before the next one."""
    drop_n_last_frames: int = 0
    """Frames at the end of every episode that no training sample starts at; actions after the end never count."""
    action_mode: Literal["delta", "absolute"] = "delta"
    """`delta`: an action moves the gripper from where it is. `absolute`: an action is where the gripper shall be, in
    the state's coordinates."""
    wrist_camera: str | None = None
    """Camera on the gripper whose colour image the network sees too, such as `wrist`. It must sit on a plane of
    symmetry of the gripper and look along it, so that the mirrored scene shows the image with its columns reversed."""
    denoiser_width: int = 256
    """Hidden numbers per group element of the network that predicts chunks."""

    aperture_noise: float = 0.0
    """Standard deviation of Gaussian noise on the state's `aperture` dimensions in training, in their unit. An expert
    opens the gripper to exactly the same aperture every time, a policy does not: without noise, the policy's own
    apertures are out of distribution."""

    def check(self) -> None:
        """Check the fields of all policies and those of chunks."""
        super().check()
        self._check_choice("action_mode", ("delta", "absolute"))
        for name, largest in {"n_obs_steps": 8, "horizon": MAX_HORIZON, "denoiser_width": 4096}.items():
            if not 1 <= getattr(self, name) <= largest:
                raise ValueError(f"--policy.{name} must lie between 1 and {largest}, got {getattr(self, name)}")
        if not 1 <= self.n_action_steps <= self.horizon:
            raise ValueError(
                f"--policy.n_action_steps must be at least 1 and at most --policy.horizon={self.horizon}, got "
                f"{self.n_action_steps}"
            )
        if self.drop_n_last_frames < 0:
            raise ValueError(f"--policy.drop_n_last_frames must not be negative, got {self.drop_n_last_frames}")
        if not 0 <= self.aperture_noise < math.inf:
            raise ValueError(f"--policy.aperture_noise must be finite and at least 0, got {self.aperture_noise}")
        if self.aperture_noise and not self.states.of_type("aperture"):
            raise ValueError(
                f"--policy.aperture_noise={self.aperture_noise} needs a dimension `aperture` in "
                f"--policy.state_symmetry, got {self.state_symmetry}"
            )
        if self.wrist_camera is not None and not self.wrist_camera.isidentifier():
            raise ValueError(f"--policy.wrist_camera must be the name of a camera, got {self.wrist_camera!r}")
        if self.wrist_camera in (self.camera, self.seen_camera, *self.merged_cameras):
            raise ValueError(
                f"--policy.wrist_camera={self.wrist_camera} is a camera of the policy's view: name that on the gripper"
            )
        _ = self.trajectories

    def substitutes(self, names: Collection[str]) -> list[str]:
        """Return the cameras of a dataset that can take the place of the policy's; the gripper's cannot."""
        return super().substitutes([name for name in names if name != wrist_key(self)])

    def set_dataset_feature_metadata(self, features: dict[str, dict[str, Any]]) -> None:
        """Choose the inputs among a dataset's features, and read the view's options and the workspace from them.

        Raises:
            ValueError: if the dataset lacks what the policy needs.
        """
        super().set_dataset_feature_metadata(features)
        key = wrist_key(self)
        if key is None or self.input_features is None:
            return
        shape = features.get(key, {}).get("shape")
        if shape is None or features[key]["dtype"] not in ("image", "video") or shape[-1] != 3:
            found = [name for name, feature in features.items() if feature["dtype"] in ("image", "video")]
            raise ValueError(
                f"--policy.wrist_camera={self.wrist_camera} needs the colour image {key!r}; the dataset has the images "
                f"{sorted(found)}"
            )
        self.input_features[key] = PolicyFeature(FeatureType.VISUAL, (3, *shape[:2]))

    @property
    def trajectories(self) -> Trajectories:
        """What converts chunks of actions to relative trajectories and back."""
        return Trajectories(self.actions, self.states, self.action_mode)

    @property
    def is_reactive(self) -> bool:
        """Whether one observation determines one action."""
        return self.n_obs_steps == self.horizon == 1

    @property
    def observation_delta_indices(self) -> list[int] | None:  # type: ignore[override]
        """The frames of a sample's observations, relative to the present one."""
        return None if self.n_obs_steps == 1 else list(range(1 - self.n_obs_steps, 1))

    @property
    def action_delta_indices(self) -> list[int] | None:  # type: ignore[override]
        """The frames of a sample's actions, relative to the present one."""
        return None if self.horizon == 1 else list(range(self.horizon))


def wrist_key(config: SymviewConfig) -> str | None:
    """Return the feature with the image of the gripper's camera; None if the policy has none."""
    camera = getattr(config, "wrist_camera", None)
    return None if camera is None else keys.rgb(camera)
