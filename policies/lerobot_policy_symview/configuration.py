"""Configuration shared by all policies: the view, the network and its symmetry. Data, with checks of its values."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode
from lerobot.optim import AdamConfig, LRSchedulerConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig

from lerobot_policy_symview.consistency import CAMERA_IMAGES, POINT_ENCODERS, check_combination, check_view
from lerobot_policy_symview.encoders import ENCODERS
from lerobot_policy_symview.methods import METHODS
from lerobot_policy_symview.symmetry.groups import GROUP_NAMES
from lerobot_policy_symview.symmetry.representations import ThetaRepresentation, VectorRepresentation
from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_calibration, parse_workspace
from lerobot_symview.geometry.gripper_state import gripper_columns, missing_of
from lerobot_symview.geometry.state_reader import ORIGINS, StateOrigin, StateReader, origin_of
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.kinematics import arm_from_plain
from lerobot_symview.kinematics.inverse import UNREACHABLE, Unreachable
from lerobot_symview.registry import check_name, lookup
from lerobot_symview.runtime import view_flags  # noqa: F401  lets draccus read and write ViewSpec
from lerobot_symview.runtime.cli import flagged
from lerobot_symview.runtime.flag_errors import flag_errors
from lerobot_symview.views import View, ViewSpec, other_cameras

RAY_CHANNELS = 6  # Plücker coordinates
CROP_SIZES = (64, 128)  # every pooling halves an even size, which keeps D4 exact; the last 8 px become 6, 3, 1
CHOICES: dict[str, tuple[Any, ...]] = {
    "modality": ("rgb", "rgbd"),
    "group": GROUP_NAMES,
    "gripper_input": ("image", "vector", "none"),
    "crop_size": CROP_SIZES,
    "theta_representation": ("sign", "trivial"),
    "augmentation": ("none", "d4", "so2", "o2", "group"),
    "dtype": ("float32", "bfloat16"),
    "learning_rate_decay": ("none", "cosine"),
    "state_origin": ("None", *ORIGINS),
    "unreachable": UNREACHABLE,
}
UNUSED_OUTPUTS = {"reproj": {"mask": False, "age": False}, "persp": {"gripper": False}}


def from_method() -> Any:
    """Return a field that is None until `__post_init__` takes it from the method's preset."""
    return field(default=None)


@dataclass
class SymviewConfig(PreTrainedConfig):
    """A policy on top-down views from freely placed cameras. The defaults are the paper's.

    Raises:
        FlagError: if a value is invalid, or values contradict each other; LeRobot's commands print the message.
    """

    method: str = "reproj_equi"
    """Preset of the next seven fields, such as one of the paper's methods; a field that is given as well takes
    precedence."""
    view: ViewSpec = field(default=None)  # type: ignore[assignment]  # as from_method
    """What the network sees: a view made from `camera` (read from the dataset where it has it), such as `reproj` or
    `{name: persp, plane_height: 0.025}`; `side`, the image of `camera` itself; or `top`, the oracle's. Options are read
    from the dataset where it has the view."""
    modality: Literal["rgb", "rgbd"] = from_method()
    """`rgbd` adds the view's height (or a camera's depth) to its colour."""
    encoder: str = from_method()
    """`equivariant`, `plain`, `relaxed` (equivariant at the start), or of points lifted from the camera's image:
    `voxel`, `point_cloud`."""
    group: str = from_method()
    """Symmetry group of the network: `D4`, `C4`, `D8`, `C8` or, for the plain encoder, `C1`."""
    gripper_input: Literal["image", "vector", "none"] = from_method()
    """How the gripper's pose enters: `image` draws it into the view or among the points and adds its height; `vector`
    gives every pixel or point x, y, z and (cos, sin) of twice the yaw; `none` leaves the paper's channels, colour,
    height and aperture."""
    camera_direction: bool = from_method()
    """Give every pixel the horizontal direction to the camera, which breaks the symmetry (paper 5.7)."""
    camera_rays: bool = from_method()
    """Give every pixel of the camera's own image its ray in the world, six Plücker coordinates; plain encoder only."""
    camera: str = "side"
    """Camera from which views are made; the view's option `cameras` merges further ones."""
    width: int = 64
    """Regular fields n of the network; 64 gives the paper's 1.1 M parameters."""
    crop_size: int = 128
    """Pixels the network sees, 128 or 64, of images downscaled to 152 or 76: a random crop in training, the centre crop
    in evaluation."""
    theta_representation: ThetaRepresentation = "sign"
    """`sign`: a reflection negates yaw increments; `trivial`: it keeps them, the paper's text."""
    relaxation_weight: float = 1e-4
    """Loss weight of the differences between orientations in relaxed layers (paper A.4)."""
    augmentation: Literal["none", "d4", "so2", "o2", "group"] = "none"
    """Transform every training sample, action included, by a random element of D4, SO(2), O(2) or `group`."""
    camera_augmentation: float = 0.0
    """Strength of random errors of calibration and depth in training, and of what hides a part of the image; 1 is up to
    1 cm and 1 degree. Views are made anew for every sample, so the dataset must have the camera's images."""
    learning_rate: float = 1e-3
    """Of Adam."""
    learning_rate_decay: Literal["none", "cosine"] = "none"
    """`cosine` anneals the learning rate to zero; `none` keeps it constant, as in the paper."""
    weight_averaging: float = 0.0
    """Decay of an exponential moving average of the weights, used in evaluation, such as 0.995; 0 for none, as in the
    paper."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Precision of convolutions, in training and evaluation; bfloat16 is for GPUs and CPUs that support it."""
    state_symmetry: list[str] = field(default_factory=lambda: ["x", "y", "z", "yaw", "aperture"])
    """Type of every dimension of `observation.state`, see `lerobot_policy_symview.symmetry.representations`."""
    action_symmetry: list[str] = field(default_factory=lambda: ["x", "y", "z", "yaw", "aperture"])
    """Type of every dimension of `action`."""
    state_origin: StateOrigin | None = None
    """What the positions in the state count from: the workspace's centre (`workspace`), the `world`, or the robot's
    `base`; by default `base` for LeRobot's names `ee.x`, …, else `workspace`."""
    state_names: list[str] = field(default_factory=list)
    """Names of the state's dimensions as the robot gives it, where it is not read as it is; read from the dataset."""
    origin_height: float = 0.0
    """Height above the table of what positions count from, metres; read from the dataset's calibration file."""
    workspace: dict[str, Any] = field(default_factory=lambda: asdict(Workspace()))
    """Constructor arguments of `Workspace`; read from the dataset."""
    calibration: dict[str, Any] = field(default_factory=dict)
    """Content of a calibration file, for observations without calibration; read from a dataset whose camera never
    moved."""

    arm: dict[str, Any] = field(default_factory=dict)
    """Arm whose joints the robot gives and takes, for a policy on the gripper's poses; read from a dataset that
    `symview-convert-actions` made."""
    max_joint_step: float = 10.0
    """Degrees by which one action may send a joint away from where it is, with `arm`; a longer way is shortened."""
    max_arm_error: float = 0.01
    """Metres by which the joints may miss what an action asks for, with `arm`; a radian counts as 0.1 m."""
    unreachable: Unreachable = "hold"
    """What to do where they would miss it by more: `hold` the arm, or stop with an `error`."""

    check_camera: bool = False
    """Keep the camera's first image of the demonstrations, and compare the first observation with it: warn of a camera
    that was moved, and do not act on an image that shows something else, or on a black view. For a camera with one
    calibration."""

    # The policy scales states and actions itself, in a way that commutes with the group; per-axis statistics do not.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION", "ENV"), NormalizationMode.IDENTITY)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        with flag_errors():
            self._apply_method()
            self.check()
            self._name_inputs()

    def _apply_method(self) -> None:
        preset = lookup("--policy.method", self.method, METHODS)
        if self.encoder == "plain" and self.group is None:
            self.group = "C1"
        for name, value in preset.items():
            if getattr(self, name) is None:
                setattr(self, name, value)
        with flagged("--policy.view"):
            self.view = ViewSpec.parse(self.view)

    def _name_inputs(self) -> None:
        from lerobot_policy_symview.inputs.feature_contract import name_inputs

        name_inputs(self)

    def check(self) -> None:
        """Raise a ValueError or SymviewError that names the flag if a value is invalid or contradicts another."""
        for name, choices in CHOICES.items():
            self._check_choice(name, choices)
        ENCODERS.check(self.encoder, "--policy.encoder")
        if not 16 <= self.width <= 1024 or self.width % 16:
            raise ValueError(f"--policy.width must be a multiple of 16 up to 1024, got {self.width}")
        if not 0 <= self.weight_averaging < 1:
            raise ValueError(f"--policy.weight_averaging must be at least 0 and below 1, got {self.weight_averaging}")
        if not 0 < self.learning_rate < math.inf:
            raise ValueError(f"--policy.learning_rate must be positive, got {self.learning_rate}")
        if not 0 <= self.camera_augmentation <= 10:
            raise ValueError(f"--policy.camera_augmentation must lie in [0, 10], got {self.camera_augmentation}")
        for name in ("max_joint_step", "max_arm_error"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"--policy.{name} must be positive, got {getattr(self, name)}")
        if self.arm:
            with flagged("--policy.arm"):
                arm_from_plain(self.arm)
        if not -3 <= self.origin_height <= 3:
            raise ValueError(f"--policy.origin_height must be metres, from -3 to 3, got {self.origin_height}")
        if not 0 <= self.relaxation_weight < math.inf:
            raise ValueError(f"--policy.relaxation_weight must not be negative, got {self.relaxation_weight}")
        with flagged("--policy.workspace"):
            parse_workspace(self.workspace)
        if self.calibration:
            with flagged("--policy.calibration"):
                parse_calibration(self.calibration)
        for kind in ("STATE", "ACTION"):
            if self.normalization_mapping.get(kind, NormalizationMode.IDENTITY) != NormalizationMode.IDENTITY:
                raise ValueError(
                    f"--policy.normalization_mapping must be IDENTITY for {kind}, got "
                    f"{self.normalization_mapping[kind]}: the policy scales it itself, as equivariance requires"
                )
        check_view(self)
        check_combination(self)
        _ = self.actions, self.states  # checked when they are parsed

    def _check_choice(self, name: str, choices: tuple[Any, ...]) -> None:
        check_name(f"--policy.{name}", str(getattr(self, name)), map(str, choices))

    @property
    def actions(self) -> VectorRepresentation:
        """How an action's dimensions transform."""
        return VectorRepresentation(tuple(self.action_symmetry), "--policy.action_symmetry")

    @property
    def states(self) -> VectorRepresentation:
        """How a state's dimensions transform."""
        return VectorRepresentation(tuple(self.state_symmetry), "--policy.state_symmetry")

    @property
    def state_reader(self) -> StateReader:
        """What reads the robot's state; `state_symmetry` is of what it reads."""
        names = self.state_names
        origin = origin_of(self.state_origin, names, parse_workspace(self.workspace), self.origin_height)
        return StateReader(tuple(names), origin if names else (0.0, 0.0, 0.0))

    @property
    def sees_points(self) -> bool:
        """Whether the encoder takes points in space rather than an image."""
        return self.encoder in POINT_ENCODERS

    @property
    def uses_calibration(self) -> bool:
        """Whether the policy needs the calibration of its camera."""
        return self.is_computed or self.sees_points or self.camera_direction or self.camera_rays

    @property
    def is_computed(self) -> bool:
        """Whether the view is made from a camera's image; `side` and `top` are camera images."""
        return self.view.name not in CAMERA_IMAGES

    @property
    def seen_camera(self) -> str:
        """The camera whose image, or view, the network sees."""
        return "top" if self.view.name == "top" else self.camera

    @property
    def color_key(self) -> str:
        """Feature with the view's colour."""
        return keys.view(self.camera, self.view.name) if self.is_computed else keys.rgb(self.seen_camera)

    @property
    def height_key(self) -> str | None:
        """Feature with the view's height or depth; None where the view has none."""
        if not self.is_computed:
            return keys.depth(self.seen_camera)
        height = f"{self.view.name}_height"
        return keys.view(self.camera, height) if height in self.make_view().outputs else None

    @property
    def image_size(self) -> int:
        """Shorter side, pixels, to which larger images are downscaled; the paper's 152 for a crop of 128."""
        return self.crop_size * 152 // 128

    @property
    def views_to_make(self) -> list[ViewSpec]:
        """The view that is made where an observation lacks it, without the outputs that the network does not read."""
        if not self.is_computed:
            return []
        unused = dict(UNUSED_OUTPUTS.get(self.view.name, {}))
        if self.view.name == "reproj":
            unused["height"] = self.modality == "rgbd"
        return [ViewSpec(self.view.name, self.view.options | unused)]

    @property
    def gripper_indices(self) -> list[int | None]:
        """Where the state has the gripper's pose, as `gripper_columns` says; none if no view is made with it.

        Raises:
            ValueError: if the view is made with it and the state lacks what is needed.
        """
        if not any(spec.make().uses_gripper for spec in self.views_to_make):
            return []
        columns = gripper_columns(self.state_symmetry, self.gripper_turns)
        if columns is None:
            raise ValueError(
                f"--policy.view={self.view.name} uses the gripper's pose; --policy.state_symmetry={self.state_symmetry}"
                f" lacks {self.missing_of_gripper}: make the view without it, by "
                "--policy.view='{name: reproj, clip: none}' or '{name: persp, plane_height: 0}', and a dataset's views "
                "by symview-add-views --reproj.clip=none or --persp.plane_height=0"
            )
        return columns

    @property
    def gripper_turns(self) -> bool:
        """Whether actions turn the gripper."""
        return bool(self.actions.of_type("yaw") or self.actions.of_type("rx"))

    @property
    def missing_of_gripper(self) -> str:
        """The dimensions that the state lacks and without which the gripper's pose is unknown; empty if it is known."""
        return missing_of(self.state_symmetry, self.gripper_turns)

    @property
    def merged_cameras(self) -> list[str]:
        """The cameras that the view merges with `camera`."""
        return other_cameras([self.make_view()], self.camera) if self.is_computed else []

    @property
    def remembers(self) -> bool:
        """Whether the view depends on the earlier frames of an episode."""
        return self.is_computed and self.make_view().memory

    def raw_keys(self, camera: str) -> list[str]:
        """Images of a camera that the policy needs to run."""
        needs_depth = self.make_view().needs_depth if self.is_computed else self.modality == "rgbd"
        return [keys.rgb(camera)] + ([keys.depth(camera)] if needs_depth else [])

    @property
    def all_raw_keys(self) -> list[str]:
        """Images that the cameras must deliver for the policy to run."""
        return [key for camera in (self.seen_camera, *self.merged_cameras) for key in self.raw_keys(camera)]

    def substitutes(self, names: Collection[str]) -> list[str]:
        """Return the cameras of a dataset that can take the place of the policy's; none if this one is there."""
        seen = [self.color_key] + ([self.height_key] if self.modality == "rgbd" and self.height_key else [])
        found = keys.substitutes(names, self.seen_camera, seen, self.raw_keys(self.seen_camera))
        return [camera for camera in found if camera not in self.merged_cameras]

    def own_names[Value](self, features: Mapping[str, Value]) -> dict[str, Value]:
        """Return features, those of the one camera that can take the place of the policy's under its names."""
        others, camera = self.substitutes(features), self.seen_camera
        if len(others) != 1:
            return dict(features)
        views = [keys.view(camera, output) for output in self.make_view().outputs] if self.is_computed else []
        own = [keys.rgb(camera), keys.depth(camera), *keys.calibration(camera), *views]
        return keys.as_camera(features, camera, others[0], own)

    @property
    def camera_calibration(self) -> dict[str, Any]:
        """`calibration`, if it has `camera`; that of other cameras is of no use."""
        return self.calibration if self.camera in self.calibration.get("cameras", {}) else {}

    @property
    def channels(self) -> int:
        """Scalar channels of the network's image, voxels or points: colour, height or occupancy, gripper, rays."""
        has_fourth = self.modality == "rgbd" and self.encoder != "point_cloud"
        return 3 + has_fourth + (self.gripper_input == "image") + (RAY_CHANNELS if self.camera_rays else 0)

    def make_view(self) -> View:
        """Return the view."""
        return self.view.make()

    def limit_view(self) -> None:
        """Let the view be no larger than the network sees, unless its size is given."""
        if self.is_computed:
            self.view = ViewSpec(self.view.name, {"size": self.image_size, **self.view.options})

    def set_dataset_feature_metadata(self, features: dict[str, dict[str, Any]]) -> None:
        """Choose the inputs among a dataset's features, and read the view's options and the workspace from them.

        LeRobot calls this before it builds the policy.
        """
        from lerobot_policy_symview.inputs.feature_contract import read_features

        read_features(self, features)

    def validate_features(self) -> None:
        """Check that LeRobot found the action among the outputs."""
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
