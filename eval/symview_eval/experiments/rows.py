"""Rows of the tables: methods and the cameras of their demonstrations. Cameras of evaluations after the training."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from lerobot_policy_symview.methods import METHODS
from lerobot_symview.geometry.miscalibration import Miscalibration
from lerobot_symview.geometry.placement import CameraSpec, CameraSpread
from lerobot_symview.views import ViewSpec


@dataclass(frozen=True)
class MethodRow:
    """A method, one row of a table."""

    name: str
    """Name of its result folder."""
    label: str
    """Its name in the paper."""
    policy: dict[str, Any] = field(hash=False)
    """Policy settings: `method`, and overrides of that method's settings. A policy of LeRobot's own sees what a policy
    of ours with these settings sees."""
    camera: CameraSpec = field(default_factory=CameraSpec)
    """The camera of the demonstrations; by default the paper's, 45 degrees above the table."""
    more_cameras: tuple[CameraSpec, ...] = ()
    """Further cameras, which the view merges."""
    longer: int = 1
    """Factor of the number of training steps."""
    chunks: str = ""
    """Kind of its policy of action chunks, a key of `Scale.chunks`; by default it is `symview_bc` with single actions,
    or in reinforcement learning `symview_sacfd`."""

    @property
    def remembers(self) -> bool:
        """Whether its view has memory, and must be added to the demonstrations before the training."""
        return bool(self.policy.get("view_options", {}).get("memory"))

    @property
    def policy_options(self) -> dict[str, Any]:
        """Constructor arguments of the policy's configuration: `view_options` are those of its method's view."""
        options = {name: value for name, value in self.policy.items() if name != "view_options"}
        if "view_options" in self.policy:
            options["view"] = ViewSpec(METHODS[options["method"]]["view"], self.policy["view_options"])
        return options


def method_row(name: str, label: str, method: str | None = None, **policy: Any) -> MethodRow:
    """Return the row of a method, by default that of its name, with overrides of the method's settings."""
    return MethodRow(name, label, {"method": method or name, **policy})


def _rgb(method: str, label: str) -> MethodRow:
    return method_row(f"{method}_rgb", f"{label} (RGB)", method, modality="rgb")


ORACLE, ORACLE_RGB = method_row("oracle_equi", "Oracle Equi"), _rgb("oracle_equi", "Oracle Equi")
REPROJ, PERSP = method_row("reproj_equi", "Reproj. Equi"), method_row("persp_equi", "Persp. Equi")
SIDE, SIDE_RGB = method_row("sideview_equi", "Sideview Equi"), _rgb("sideview_equi", "Sideview Equi")
PLAIN, PLAIN_RGB = method_row("sideview_nonequi", "Sideview NonEqui"), _rgb("sideview_nonequi", "Sideview NonEqui")
VOXEL, CLOUD = method_row("voxel_equi", "Voxel Equi"), method_row("point_cloud_equi", "Point Cloud Equi")

BROKEN = method_row("persp_equi_broken", "Persp. Equi (broken)")
PLUCKER = method_row("sideview_plucker", "Sideview Plücker")

CLONED_TASKS = ("block_picking", "block_pushing", "drawer_opening", "block_stacking", "block_in_bowl")
ABLATION_TASKS = ("drawer_opening", "block_stacking", "block_in_bowl")
ELEVATIONS = (15.0, 30.0, 45.0, 60.0, 75.0)


def _miscalibrated(**errors: float) -> CameraSpec:
    return CameraSpec(miscalibration=Miscalibration(**errors))


def at_elevation(row: MethodRow, elevation_deg: float) -> MethodRow:
    """Return the row with demonstrations by a camera at an elevation."""
    camera = CameraSpec(elevation_deg=elevation_deg)
    name, label = f"{row.name}_{elevation_deg:g}deg", f"{row.label}, {elevation_deg:g}°"
    return replace(row, name=name, label=label, camera=camera)


def _in_chunks(chunks: str, name: str, label: str, method: str, longer: int = 1, **policy: Any) -> MethodRow:
    """Return the row of a kind of policy that predicts chunks, with what a method sees."""
    kind = {"symview_flow": "flow", "symview_bc": "regression"}.get(chunks, chunks)
    return replace(method_row(f"{kind}_{name}", label, method, **policy), longer=longer, chunks=chunks)


ACT = (
    _in_chunks("act_single", "reproj", "ACT, reprojected view", "reproj_equi", modality="rgb"),
    _in_chunks("act_single", "sideview", "ACT, side image", "sideview_equi", modality="rgb"),
)
TRANSFERRED = (REPROJ, PERSP, BROKEN, SIDE, PLAIN, PLUCKER, VOXEL, CLOUD, *ACT)
ANYWHERE = CameraSpread(elevation_deg=20.0, azimuth_deg=180.0)
PLACEMENTS = (
    ("training", CameraSpec()),
    *(
        (f"azimuth {azimuth:+d}°", CameraSpec(azimuth_deg=azimuth))
        for azimuth in (-135, -90, -45, -20, 20, 45, 90, 135)
    ),
    *((f"elevation {elevation}°", CameraSpec(elevation_deg=elevation)) for elevation in (15, 30, 60, 75)),
    ("distance 1.1 m", CameraSpec(distance=1.1)),
    ("field of view 60°", CameraSpec(fov_deg=60.0)),
    ("new in every episode", CameraSpec(spread=ANYWHERE)),
)


AUGMENTED = method_row(
    "reproj_equi_augmented", "Reproj. Equi, camera augmentation", "reproj_equi", camera_augmentation=1.0
)
WITH_ERRORS = (REPROJ, AUGMENTED, PERSP, SIDE, PLAIN, VOXEL, CLOUD)
SENSORS = (
    ("exact", CameraSpec()),
    *((f"position {100 * metres:g} cm", _miscalibrated(position=metres)) for metres in (0.005, 0.01, 0.02, 0.03)),
    *((f"rotation {degrees:g}°", _miscalibrated(rotation_deg=degrees)) for degrees in (0.5, 1.0, 2.0, 5.0)),
    ("1 cm and 1°", _miscalibrated(position=0.01, rotation_deg=1.0)),
    *((f"focal length {100 * error:g} %", _miscalibrated(focal=error)) for error in (0.01, 0.025, 0.05)),
    *((f"depth noise {1000 * metres:g} mm", CameraSpec(depth_noise=metres)) for metres in (0.001, 0.0025, 0.005)),
    *((f"depth dropout {100 * share:g} %", CameraSpec(depth_dropout=share)) for share in (0.01, 0.1)),
    ("flying pixels 50 %", CameraSpec(flying_pixels=0.5)),
    ("late by an action", CameraSpec(delay=1)),
)


WEBCAM = (-0.3, 0.1, 0.0, 0.0)  # k1, k2, p1, p2: barrel distortion as of a wide-angle webcam, 16 pixels in a corner
LENSES = (
    ("without a lens", CameraSpec()),
    ("known", CameraSpec(distortion=WEBCAM)),
    ("left out of the calibration", CameraSpec(distortion=WEBCAM, distortion_known=False)),
)


SECOND_CAMERA = CameraSpec("left", azimuth_deg=90.0)


def seeing_more(name: str, label: str, *cameras: CameraSpec, arm: bool = True, memory: bool = False) -> MethodRow:
    """Return reproj_equi with further cameras, without the arm in its images, or with memory."""
    merged = {"cameras": [camera.name for camera in cameras]} if cameras else {}
    options = merged | ({"memory": True} if memory else {})
    policy = {"method": "reproj_equi", **({"view_options": options} if options else {})}
    return MethodRow(f"reproj_equi_{name}", f"Reproj. Equi, {label}", policy, CameraSpec(sees_robot=arm), cameras)


def with_varying_camera(row: MethodRow) -> MethodRow:
    """Return the row with demonstrations by a new camera in every episode."""
    camera = CameraSpec(spread=ANYWHERE)
    name, label = f"{row.name}_varying", f"{row.label}, trained with many cameras"
    return replace(row, name=name, label=label, camera=camera)


FOREIGN_CAMERA = CameraSpec(azimuth_deg=60.0, distance=1.0)
FOREIGN_MOVED = (
    ("training", FOREIGN_CAMERA),
    *((f"azimuth {azimuth}°", replace(FOREIGN_CAMERA, azimuth_deg=azimuth)) for azimuth in (-60, 0, 90, 120)),
    *((f"elevation {elevation}°", replace(FOREIGN_CAMERA, elevation_deg=elevation)) for elevation in (30, 60)),
)


def in_foreign_world(row: MethodRow, longer: int = 1) -> MethodRow:
    """Return the row with demonstrations of a simulator that others wrote, and a factor of the training steps."""
    return replace(row, camera=FOREIGN_CAMERA, longer=longer)


def _around_gripper(name: str, label: str, **policy: Any) -> MethodRow:
    """Return reproj_equi without the arm over the gripper only: objects beside it may be higher than it."""
    return method_row(name, label, "reproj_equi", view_options={"clip_radius": 0.12}, **policy)


FOREIGN = (
    in_foreign_world(_around_gripper("reproj_equi_around", "Reproj. Equi, clip radius")),
    in_foreign_world(REPROJ),
    in_foreign_world(_around_gripper("reproj_nonequi_around", "Reproj. NonEqui, clip radius", encoder="plain")),
    in_foreign_world(PERSP),
    in_foreign_world(SIDE),
    in_foreign_world(PLAIN),
    in_foreign_world(method_row("sideview_equi_longer", "Sideview Equi, 5 x as many steps", "sideview_equi"), longer=5),
    *(in_foreign_world(row) for row in ACT),
)


CHUNKS_MOVED = (
    ("training", CameraSpec()),
    *((f"azimuth {azimuth:+d}°", CameraSpec(azimuth_deg=azimuth)) for azimuth in (-90, -45, 45, 90)),
)


CHUNKED = (
    _in_chunks("symview_flow", "oracle_equi", "Oracle Equi, flow", "oracle_equi"),
    _in_chunks("symview_flow", "reproj_equi", "Reproj. Equi, flow", "reproj_equi"),
    _in_chunks("symview_flow", "sideview_equi", "Sideview Equi, flow", "sideview_equi"),
    _in_chunks("symview_flow", "reproj_nonequi", "Reproj. NonEqui, flow", "reproj_equi", encoder="plain", longer=2),
    _in_chunks("symview_bc", "reproj_equi", "Reproj. Equi, regression of chunks", "reproj_equi"),
    _in_chunks("act", "reproj", "ACT, reprojected view", "reproj_equi", modality="rgb"),
    _in_chunks("act", "sideview", "ACT, side image", "sideview_equi", modality="rgb"),
    _in_chunks("act", "reproj_longer", "ACT, view, 5 x as many steps", "reproj_equi", longer=5, modality="rgb"),
    _in_chunks("diffusion", "reproj", "Diffusion Policy, reprojected view", "reproj_equi", modality="rgb"),
    _in_chunks("diffusion", "sideview", "Diffusion Policy, side image", "sideview_equi", modality="rgb"),
    _in_chunks(
        "diffusion",
        "reproj_longer",
        "Diffusion Policy, view, 5 x as many steps",
        "reproj_equi",
        longer=5,
        modality="rgb",
    ),
)


def with_plane_height(name: str, label: str, plane_height: float | str) -> MethodRow:
    """Return persp_equi_broken with another height of the warped plane."""
    return method_row(name, label, "persp_equi_broken", view_options={"plane_height": plane_height})
