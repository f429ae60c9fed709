"""What every policy of symview is configured by: what it sees, its network and its symmetry."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.optim import AdamConfig, LRSchedulerConfig

from lerobot_policy_symview.methods import METHODS
from lerobot_policy_symview.symmetry.groups import GROUP_NAMES, make_group
from lerobot_policy_symview.symmetry.representations import Symmetry, ThetaRepresentation
from lerobot_symview import keys
from lerobot_symview.calibration.file import parse_calibration, parse_workspace
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.registry import added, lookup
from lerobot_symview.views import VIEWS, View, make_view

CAMERA_IMAGES = ("side", "top")  # views that are a camera's own image: nothing is computed
ENCODER_NAMES = ("equivariant", "plain", "relaxed", "voxel", "point_cloud")
LIFTING = ("voxel", "point_cloud")  # encoders that see the camera's image as points in space
CROP_SIZES = (64, 128)  # every pooling halves an even size, which keeps D4 exact; the last 8 px become 6, 3, 1
CHOICES: dict[str, tuple[Any, ...]] = {
    "modality": ("rgb", "rgbd"),
    "encoder": ENCODER_NAMES,
    "group": GROUP_NAMES,
    "gripper_input": ("image", "vector", "none"),
    "crop_size": CROP_SIZES,
    "theta_representation": ("sign", "trivial"),
    "augmentation": ("none", "d4", "so2", "o2", "group"),
    "dtype": ("float32", "bfloat16"),
}
EXTENSIBLE = {"view": "symview.views", "encoder": "symview.encoders"}  # by entry points of these groups


def as_method_says() -> Any:
    """Return a field that is None until `__post_init__` takes it from the method."""
    return field(default=None)


@dataclass
class SymviewConfig(PreTrainedConfig):
    """A policy that acts on views of a freely placed camera. The defaults are the paper's."""

    method: str = "reproj_equi"
    """Preset of the six fields below, one of the paper's methods; a field that is stated wins."""
    view: str = as_method_says()
    """What the network sees: `reproj` or `persp` (made from `camera`, read from the dataset where it has them), `side`
    (the image of `camera` itself), `top` (the oracle).
    """
    modality: Literal["rgb", "rgbd"] = as_method_says()
    """`rgbd` adds the view's height (or a camera's depth) to its colour, `rgb` does not."""
    encoder: str = as_method_says()
    """`equivariant`, `plain`, `relaxed` (equivariant at the start), and of the camera's image lifted to points in
    space: `voxel`, `point_cloud`.
    """
    group: str = as_method_says()
    """Symmetry built into the network: `D4`, `C4`, `D8`, `C8` or, for the plain one, `C1`."""
    gripper_input: Literal["image", "vector", "none"] = as_method_says()
    """How the gripper's pose enters: `image` draws it into a top-down view and adds its height, `vector` gives every
    pixel x, y, z and twice the yaw, `none` leaves the paper's channels, colour, height and aperture.
    """
    camera_direction: bool = as_method_says()
    """Give every pixel the horizontal direction to the camera, which breaks the symmetry (paper 5.7)."""
    camera: str = "side"
    """Camera that views are made from."""
    width: int = 64
    """Regular fields n of the network; 64 gives the paper's 1.1 M parameters."""
    crop_size: int = 128
    """Pixels the network sees, 128 or 64: of images scaled down to 152 or 76, a random part in training, the middle in
    evaluation.
    """
    theta_representation: ThetaRepresentation = "sign"
    """`sign`: yaw increments change sign in a mirror; `trivial`: the paper's text."""
    relaxation_weight: float = 1e-4
    """Weight in the loss of the differences that relaxed layers make between orientations (paper A.4)."""
    augmentation: Literal["none", "d4", "so2", "o2", "group"] = "none"
    """Move each training sample, action included, by a random element: quarter turns and mirror images, any turn, any
    turn and mirror images, or what `group` has.
    """
    learning_rate: float = 1e-3
    """Of Adam."""
    weight_averaging: float = 0.0
    """Decay of an exponential average of the weights that acts in evaluation, such as 0.995; 0 for none, as in the
    paper.
    """
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Precision of convolutions, in training and evaluation; bfloat16 is for GPUs and for processors that have it."""
    state_symmetry: list[str] = field(default_factory=lambda: ["x", "y", "z", "yaw", "aperture"])
    """Kind of each entry of `observation.state`, see `lerobot_policy_symview.symmetry.representations`."""
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
        preset = lookup("--policy.method", self.method, METHODS)
        if self.encoder == "plain" and self.group is None:
            self.group = "C1"
        for name, value in preset.items():
            if getattr(self, name) is None:
                setattr(self, name, value)
        for name, choices in (CHOICES | {"view": (*CAMERA_IMAGES, *VIEWS)}).items():
            self._check_choice(name, choices)
        if not 16 <= self.width <= 1024 or self.width % 16:
            raise ValueError(f"--policy.width must be a multiple of 16 up to 1024, got {self.width}")
        if not 0 <= self.weight_averaging < 1:
            raise ValueError(f"--policy.weight_averaging must be at least 0 and below 1, got {self.weight_averaging}")
        for kind in ("STATE", "ACTION"):
            if self.normalization_mapping.get(kind, NormalizationMode.IDENTITY) != NormalizationMode.IDENTITY:
                raise ValueError(
                    f"--policy.normalization_mapping must be IDENTITY for {kind}, got "
                    f"{self.normalization_mapping[kind]}: the policy scales it by itself, as the symmetry demands"
                )
        self._check_combination()
        _ = self.actions, self.states  # declarations are checked when they are parsed

    def _check_choice(self, name: str, choices: tuple[Any, ...]) -> None:
        value, names = str(getattr(self, name)), tuple(map(str, choices))
        if value not in names:
            names += tuple(added(EXTENSIBLE[name])) if name in EXTENSIBLE else ()
            lookup(f"--policy.{name}", value, dict.fromkeys(names))

    def _check_combination(self) -> None:
        if (self.encoder == "plain") != (self.group == "C1"):
            raise ValueError(
                f"--policy.encoder={self.encoder} does not go with --policy.group={self.group}: "
                "the plain encoder has the group C1, and only that"
            )
        if self.encoder in ("relaxed", *LIFTING) and not make_group(self.group).is_exact:
            raise ValueError(
                f"--policy.encoder={self.encoder} has filters of single pixels, which 45 degrees do not turn into each "
                f"other: use --policy.group=D4, got {self.group}"
            )
        if self.encoder in LIFTING and (self.view, self.modality, self.gripper_input) != ("side", "rgbd", "vector"):
            raise ValueError(
                f"--policy.encoder={self.encoder} lifts the camera's own image: use --policy.view=side, "
                f"--policy.modality=rgbd and --policy.gripper_input=vector, got {self.view}, {self.modality} and "
                f"{self.gripper_input}"
            )
        if self.is_computed and self.modality == "rgbd" and self.height_key is None:
            raise ValueError(f"the view {self.view!r} has no height; use --policy.modality=rgb")
        if self.view == "side" and self.gripper_input == "image":
            raise ValueError(
                "--policy.gripper_input=image draws the gripper as seen from above, which --policy.view=side is not: "
                "use --policy.gripper_input=vector, or --policy.method=sideview_equi for both"
            )
        roles = {"image": keys.STATE_NAMES, "vector": (), "none": ()}[self.gripper_input]
        missing = [kind for kind in roles if kind not in self.state_symmetry]
        if missing:
            raise ValueError(
                f"--policy.gripper_input=image draws the gripper's {', '.join(roles)}; --policy.state_symmetry="
                f"{self.state_symmetry} lacks {missing}: use --policy.gripper_input=vector"
            )
        if self.augmentation != "none":
            self._check_augmentation()

    def _check_augmentation(self) -> None:
        if self.augmentation == "group" and self.group == "C1":
            raise ValueError(
                "--policy.augmentation=group moves nothing with --policy.group=C1: "
                "use --policy.augmentation=d4, so2 or o2"
            )
        if self.gripper_input == "none" or not self.states.of_kind("yaw"):
            raise ValueError(
                f"--policy.augmentation={self.augmentation} turns the gripper with the scene, but its yaw does not "
                f"enter the network with --policy.gripper_input={self.gripper_input} and --policy.state_symmetry="
                f"{self.state_symmetry}: let a yaw enter, or use --policy.augmentation=none"
            )

    @property
    def actions(self) -> Symmetry:
        """How an action's entries move."""
        return Symmetry(tuple(self.action_symmetry), "--policy.action_symmetry")

    @property
    def states(self) -> Symmetry:
        """How a state's entries move."""
        return Symmetry(tuple(self.state_symmetry), "--policy.state_symmetry")

    @property
    def is_computed(self) -> bool:
        """Whether the view is made from a camera's image rather than being one."""
        return self.view not in CAMERA_IMAGES

    @property
    def seen_camera(self) -> str:
        """The camera whose image, made into a view or not, the network sees."""
        return "top" if self.view == "top" else self.camera

    @property
    def color_key(self) -> str:
        """Feature with the view's colour."""
        return keys.view(self.camera, self.view) if self.is_computed else keys.rgb(self.seen_camera)

    @property
    def height_key(self) -> str | None:
        """Feature with the view's height or depth; None where the view has none."""
        if not self.is_computed:
            return keys.depth(self.seen_camera)
        height = f"{self.view}_height"
        return keys.view(self.camera, height) if height in self._made_view().outputs else None

    @property
    def image_size(self) -> int:
        """Pixels of the shorter side that larger images are scaled down to; the paper's 152 for a crop of 128."""
        return self.crop_size * 152 // 128

    @property
    def network_keys(self) -> list[str]:
        """Features of a preprocessed observation that the network's input is made of."""
        found = [self.color_key, keys.STATE]
        if self.modality == "rgbd":
            assert self.height_key is not None
            found.append(self.height_key)
        if self.camera_direction or self.encoder in LIFTING:
            found += [keys.intrinsics(self.camera), keys.world_from_cam(self.camera)]
        if self.view == "top" and self.modality == "rgbd":
            found.append(keys.world_from_cam("top"))
        return found

    @property
    def computed_views(self) -> dict[str, dict[str, Any]]:
        """Name and options of the view to make where an observation lacks it, with no output that is not needed."""
        if not self.is_computed:
            return {}
        needless = {"reproj": {"height": self.modality == "rgbd", "mask": False}, "persp": {"gripper": False}}
        return {self.view: self.view_options | needless.get(self.view, {})}

    @property
    def gripper_entries(self) -> list[int]:
        """Which entries of the state are the gripper's x, y, z, yaw and aperture; none if no view is made with them.

        Raises:
            ValueError: if the view cannot be made without them and the state lacks some.
        """
        if not any(make_view(name, **options).needs_gripper for name, options in self.computed_views.items()):
            return []
        missing = [kind for kind in keys.STATE_NAMES if kind not in self.state_symmetry]
        if missing:
            raise ValueError(
                f"--policy.view={self.view} is made with the gripper's {', '.join(keys.STATE_NAMES)}; "
                f"--policy.state_symmetry={self.state_symmetry} lacks {missing}: make it without, by "
                "--policy.view_options='{clip: none}' (reproj) or '{plane_height: 0}' (persp), and a dataset's views "
                "by symview-add-views --reproj.clip=none or --persp.plane_height=0"
            )
        return [self.state_symmetry.index(kind) for kind in keys.STATE_NAMES]

    @property
    def raw_keys(self) -> list[str]:
        """Features a camera must deliver for the policy to run."""
        if not self.is_computed:
            return [self.color_key] + ([keys.depth(self.seen_camera)] if self.modality == "rgbd" else [])
        return [keys.rgb(self.camera)] + ([keys.depth(self.camera)] if self._made_view().needs_depth else [])

    @property
    def channels(self) -> int:
        """Scalar channels of the network's picture."""
        return 3 + (self.modality == "rgbd") + (self.gripper_input == "image")

    def limit_view(self) -> None:
        """Have the view made no larger than the network sees, unless its size is stated."""
        if self.is_computed:
            self.view_options = {"size": self.image_size, **self.view_options}

    def set_dataset_feature_metadata(self, features: dict[str, dict[str, Any]]) -> None:
        """Choose the inputs among a dataset's `features`, and read the view's options and the workspace from them.

        LeRobot calls this before it builds the policy. It also accepts no visual feature at evaluation that was not
        declared here, so the raw images are declared even when training reads only views made from them.
        """
        for symmetry, key in ((self.states, keys.STATE), (self.actions, keys.ACTION)):
            size, names = _entries(features, key)
            symmetry.check(size, key, names if self.group != "C1" else None)
        made = features.get(self.color_key, {}).get("info") or {}
        if self.is_computed and "symview" in made:
            try:
                self.view_options = dict(made["symview"]["options"])
                self.workspace = dict(made["symview"]["workspace"])
                self.calibration = dict(made["symview"].get("calibration", self.calibration))
                self._made_view()
                parse_workspace(self.workspace)
                if self.calibration:
                    parse_calibration(self.calibration)
            except (KeyError, TypeError, ValueError) as error:
                raise ValueError(f"the dataset does not say how {self.color_key} was made: {error}") from None
        else:
            raw = features.get(self.raw_keys[0], {}).get("info") or {}
            self.workspace = dict(raw.get("symview", {}).get("workspace", self.workspace))
        has_raw = all(key in features for key in self.raw_keys)
        if not has_raw and self.color_key not in features:
            raise ValueError(
                f"--policy.view={self.view} needs {self.raw_keys} or {self.color_key!r}; "
                f"the dataset has {sorted(key for key in features if 'images' in key)}"
            )
        is_recorded = self.color_key in features
        size = min(features[self.color_key]["shape"][:2]) if is_recorded else self._made_view().size
        if size < self.crop_size and self.encoder not in LIFTING:
            raise ValueError(
                f"--policy.crop_size={self.crop_size} is larger than the {size} px of the shorter side of "
                f"{self.color_key!r}: lower it or make larger views"
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
        """The rate stays as it is."""
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


def _entries(features: dict[str, dict[str, Any]], key: str) -> tuple[int, list[str] | None]:
    if key not in features:
        raise ValueError(
            f"the dataset has no feature {key!r}, which symview's policies need; it has {sorted(features)}"
        )
    names = features[key].get("names")
    are_names = isinstance(names, list) and all(isinstance(name, str) for name in names)
    return int(features[key]["shape"][0]), names if are_names else None


def _channel_first(features: dict[str, dict[str, Any]], key: str) -> tuple[int, ...]:
    """Shape (C, H, W) of an image feature; a raw image that the dataset dropped is stated as its camera's kind only."""
    if key not in features:
        return (1 if key.endswith("_depth") else 3, 0, 0)
    height, width, channels = features[key]["shape"]
    return (channels, height, width)
