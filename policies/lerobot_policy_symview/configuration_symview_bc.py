"""Configuration of the behaviour-cloning policy."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.optim import AdamConfig, LRSchedulerConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig

from lerobot_policy_symview.symmetry import ThetaRepresentation, check_declaration
from lerobot_symview import keys
from lerobot_symview.names import lookup
from lerobot_symview.views import VIEWS, View, make_view
from lerobot_symview.workspace import Workspace

CAMERA_IMAGES = ("side", "top")  # views that are a camera's own image: nothing is computed
ENCODER_NAMES = ("equivariant", "plain")
CROP_SIZES = (64, 128)  # every pooling halves an even size, which keeps D4 exact; the last 8 px become 6, 3, 1


@PreTrainedConfig.register_subclass("symview_bc")
@dataclass
class SymviewBcConfig(PreTrainedConfig):
    """Behaviour cloning from views of a freely placed camera. The defaults are the paper's."""

    view: str = "reproj"
    """What the network sees: `reproj` or `persp` (made from `camera`, read from the dataset where it has them), `side`
    (the camera's own image), `top` (the oracle).
    """
    camera: str = "side"
    """Camera that views are made from."""
    modality: Literal["rgb", "rgbd"] = "rgbd"
    """`rgbd` adds the view's height (or a camera's depth) to its colour, `rgb` does not."""
    encoder: str = "equivariant"
    """`equivariant` (D4) or `plain`."""
    width: int = 64
    """Regular fields n of the network; 64 gives the paper's 1.1 M parameters."""
    crop_size: int = 128
    """Pixels the network sees; a random crop in training, the middle in evaluation."""
    gripper_input: Literal["image", "none"] = "image"
    """`image` draws the gripper into the view as a channel and adds its height; `none` leaves the paper's channels,
    colour, height and aperture.
    """
    theta_representation: ThetaRepresentation = "sign"
    """`sign`: yaw increments change sign in a mirror; `trivial`: the paper's text."""
    rotation_augmentation: bool = False
    """Turn each training sample by a random angle, action included."""
    learning_rate: float = 1e-3
    """Of Adam."""
    learning_rate_decay: Literal["none", "cosine"] = "none"
    """`cosine` lowers the rate to zero over the training, `none` keeps it, as in the paper."""
    state_symmetry: list[str] = field(default_factory=lambda: ["x", "y", "z", "yaw", "aperture"])
    """Kind of each entry of `observation.state`, see `lerobot_policy_symview.symmetry`."""
    action_symmetry: list[str] = field(default_factory=lambda: ["x", "y", "z", "yaw", "aperture"])
    """Kind of each entry of `action`."""
    view_options: dict[str, Any] = field(default_factory=dict)
    """Options of the view; filled in from the dataset where that has the view."""
    workspace: dict[str, Any] = field(default_factory=lambda: asdict(Workspace()))
    """Constructor arguments of `Workspace`; filled in from the dataset."""
    calibration: dict[str, Any] = field(default_factory=dict)
    """Content of the calibration file, for observations without calibration; filled in from the dataset."""

    # The policy scales actions itself, in a way that commutes with the group; per-axis statistics would not.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION", "ENV"), NormalizationMode.IDENTITY)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        lookup("--policy.view", self.view, dict.fromkeys((*CAMERA_IMAGES, *VIEWS)))
        lookup("--policy.encoder", self.encoder, dict.fromkeys(ENCODER_NAMES))
        for name, value, choices in (
            ("modality", self.modality, ("rgb", "rgbd")),
            ("crop_size", self.crop_size, CROP_SIZES),
            ("gripper_input", self.gripper_input, ("image", "none")),
            ("theta_representation", self.theta_representation, ("sign", "trivial")),
            ("learning_rate_decay", self.learning_rate_decay, ("none", "cosine")),
        ):
            if value not in choices:
                raise ValueError(f"--policy.{name} must be one of {', '.join(map(str, choices))}, got {value!r}")
        if self.width < 8 or self.width % 8:
            raise ValueError(f"--policy.width must be a positive multiple of 8, got {self.width}")
        check_declaration("state_symmetry", self.state_symmetry)
        check_declaration("action_symmetry", self.action_symmetry)
        if self.is_computed and self.modality == "rgbd" and self.height_key is None:
            raise ValueError(f"the view {self.view!r} has no height; use --policy.modality=rgb")

    @property
    def is_computed(self) -> bool:
        """Whether the view is made from a camera's image rather than being one."""
        return self.view not in CAMERA_IMAGES

    @property
    def color_key(self) -> str:
        """Feature with the view's colour."""
        return keys.view(self.camera, self.view) if self.is_computed else keys.rgb(self.view)

    @property
    def height_key(self) -> str | None:
        """Feature with the view's height or depth; None where the view has none."""
        if not self.is_computed:
            return keys.depth(self.view)
        height = f"{self.view}_height"
        return keys.view(self.camera, height) if height in self._made_view().outputs else None

    @property
    def raw_keys(self) -> list[str]:
        """Features a camera must deliver for the policy to run."""
        if not self.is_computed:
            return [self.color_key] + ([keys.depth(self.view)] if self.modality == "rgbd" else [])
        return [keys.rgb(self.camera)] + ([keys.depth(self.camera)] if self._made_view().needs_depth else [])

    @property
    def channels(self) -> int:
        """Input channels of the network."""
        return 3 + (self.modality == "rgbd") + (2 if self.gripper_input == "image" else 0) + 1

    def set_dataset_feature_metadata(self, features: dict[str, dict[str, Any]]) -> None:
        """Choose the inputs among a dataset's `features`, and read the view's options and the workspace from them.

        LeRobot calls this before it builds the policy. It also accepts no visual feature at evaluation that was not
        declared here, so the raw images are declared even when training reads only views made from them.
        """
        check_declaration("state_symmetry", self.state_symmetry, _entries(features, keys.STATE))
        check_declaration("action_symmetry", self.action_symmetry, _entries(features, keys.ACTION))
        made = features.get(self.color_key, {}).get("info") or {}
        if self.is_computed and "symview" in made:
            self.view_options = dict(made["symview"]["options"])
            self.workspace = dict(made["symview"]["workspace"])
            self.calibration = dict(made["symview"].get("calibration", self.calibration))
        else:
            raw = features.get(self.raw_keys[0], {}).get("info") or {}
            self.workspace = dict(raw.get("symview", {}).get("workspace", self.workspace))
        has_raw = all(key in features for key in self.raw_keys)
        if not has_raw and self.color_key not in features:
            raise ValueError(
                f"--policy.view={self.view} needs {self.raw_keys} or {self.color_key!r}; "
                f"the dataset has {sorted(key for key in features if 'images' in key)}"
            )
        size = features[self.color_key]["shape"][0] if self.color_key in features else self._made_view().size
        if size < self.crop_size:
            raise ValueError(
                f"--policy.crop_size={self.crop_size} is larger than the {size} px view {self.color_key!r}: "
                "lower it or make larger views"
            )
        visuals = list(self.raw_keys)
        if not has_raw:
            visuals += [key for key, feature in features.items() if feature["dtype"] in ("image", "video")]
        self.input_features = {
            keys.STATE: PolicyFeature(FeatureType.STATE, tuple(features[keys.STATE]["shape"])),
            **{key: PolicyFeature(FeatureType.VISUAL, _channel_first(features, key)) for key in visuals},
        }
        self.output_features = {keys.ACTION: PolicyFeature(FeatureType.ACTION, tuple(features[keys.ACTION]["shape"]))}

    def _made_view(self) -> View:
        return make_view(self.view, **self.view_options)

    def validate_features(self) -> None:
        """Check that the inputs and outputs LeRobot settled on are there."""
        if not self.output_features or keys.ACTION not in self.output_features:
            raise ValueError("the dataset or environment has no feature 'action'")

    def get_optimizer_preset(self) -> AdamConfig:
        """Return the paper's Adam with its default parameters."""
        return AdamConfig(lr=self.learning_rate)

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """Return the schedule that `learning_rate_decay` names."""
        if self.learning_rate_decay == "cosine":
            return CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=0)
        return None

    @property
    def observation_delta_indices(self) -> None:
        """One observation per sample."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """One action per sample."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """No rewards."""
        return None


def _entries(features: dict[str, dict[str, Any]], key: str) -> int:
    if key not in features:
        raise ValueError(f"the dataset has no feature {key!r}, which symview_bc needs; it has {sorted(features)}")
    return int(features[key]["shape"][0])


def _channel_first(features: dict[str, dict[str, Any]], key: str) -> tuple[int, ...]:
    """Shape (C, H, W) of an image feature; a raw image that the dataset dropped is stated as its camera's kind only."""
    if key not in features:
        return (1 if key.endswith("_depth") else 3, 0, 0)
    height, width, channels = features[key]["shape"]
    return (channels, height, width)
