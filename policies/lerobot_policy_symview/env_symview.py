"""The simulated tasks as a LeRobot environment: `--env.type=symview`."""

from __future__ import annotations

import multiprocessing
from dataclasses import asdict, dataclass, field
from typing import Any

import gymnasium
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import _LazyAsyncVectorEnv, freeze_after_episode_end
from lerobot.processor import PolicyProcessorPipeline

from lerobot_policy_symview.processor_views import ViewsProcessorStep
from lerobot_symview import keys
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.geometry.units import Unit
from lerobot_symview.runtime.view_flags import views_from_flags
from lerobot_symview.views import PerspectiveView, ReprojectedView, View, ViewSpec

# What a simulator process imports; loaded once by the fork server instead of six seconds in each process.
PRELOADED = ["lerobot.envs.utils", "symview_sim.env"]


@EnvConfig.register_subclass("symview")
@dataclass
class SymviewEnvConfig(EnvConfig):
    """PyBullet tabletop tasks seen by freely placed RGBD cameras."""

    task: str = "block_picking"
    """Which task, such as `block_picking`; several with commas between them, or `all`."""
    fps: int = 4
    """Actions per second of a robot that takes as long as the simulated one."""
    robot: str = "panda"
    """Which arm, `panda` or `kuka`."""
    camera: CameraSpec = field(default_factory=CameraSpec)
    """Where the camera stands and what it sees."""
    more_cameras: tuple[CameraSpec, ...] = ()
    """Further cameras, such as `[{name: left, azimuth_deg: 90}]`."""
    oracle: bool = False
    """Add the camera `top`, which looks straight down and does not see the arm."""
    depth: bool = True
    """Observe depth."""
    segmentation: bool = False
    """Observe which pixel shows table, robot or which object."""
    views: list[ViewSpec] = field(default_factory=list)
    """Views of the first camera to add to each observation, for policies that do not make their own: by name or with
    options, `[reproj, {name: persp, plane_height: 0.025}]`."""
    view_size: int | None = None
    """Rows and columns of the views that do not have a size of their own in `views`."""
    reproj: ReprojectedView = field(default_factory=ReprojectedView)
    """Options of the view reproj."""
    persp: PerspectiveView = field(default_factory=PerspectiveView)
    """Options of the view persp."""
    start_jitter: float = 0.0
    """Largest random displacement of the gripper's start position per axis, metres."""
    max_steps: int = 50
    """Actions per episode."""

    def __post_init__(self) -> None:
        cameras = [self.camera, *self.more_cameras]
        sizes = {camera.name: (camera.height, camera.width) for camera in cameras}
        if self.oracle:
            sizes["top"] = (self.camera.height, self.camera.height)
        shapes: dict[str, tuple[int, ...]] = {}
        for name, size in sizes.items():
            shapes[keys.rgb(name)] = (*size, 3)
            if self.depth:
                shapes[keys.depth(name)] = (*size, 1)
            if self.segmentation:
                shapes[keys.segmentation(name)] = (*size, 3)
        for name, view in self._make_views().items():
            if view.needs_depth and not self.depth:
                raise ValueError(f"the view {name!r} needs depth: leave --env.depth=true or use 'persp'")
            for output, kind in view.outputs.items():
                shapes[keys.view(self.camera.name, output)] = (view.size, view.size, 3 if kind == "rgb" else 1)
        self.features = {
            keys.ACTION: PolicyFeature(FeatureType.ACTION, (len(keys.ACTION_NAMES),)),
            keys.STATE: PolicyFeature(FeatureType.STATE, (len(keys.STATE_NAMES),)),
            **{key: PolicyFeature(FeatureType.VISUAL, shape) for key, shape in shapes.items()},
        }
        self.features_map = {key: key for key in self.features}

    def _make_views(self) -> dict[str, View]:
        options: dict[str, View] = {"reproj": self.reproj, "persp": self.persp}
        return views_from_flags(self.views, self.view_size, options) if self.views else {}

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Settings of every simulated environment but its task, see `symview_sim.settings.EnvSettings`."""
        names = (
            "robot", "camera", "more_cameras", "oracle", "depth", "segmentation", "start_jitter", "max_steps",
        )  # fmt: skip
        return {name: getattr(self, name) for name in names}

    @property
    def tasks(self) -> list[str]:
        """Names of the tasks."""
        from symview_sim.tasks import TASK_NAMES

        return list(TASK_NAMES) if self.task == "all" else [name.strip() for name in self.task.split(",")]

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
        """Return `{task: {0: a vector environment of n_envs}}`.

        Asynchronous ones, only where there are several, start their processes when they are first reset, so that a
        suite never runs more than one task's.
        """
        from symview_sim.settings import EnvSettings

        settings = {task: EnvSettings(task=task, **self.gym_kwargs) for task in self.tasks}
        if not use_async_envs or n_envs == 1:
            return {
                task: {0: gymnasium.vector.SyncVectorEnv([freeze_after_episode_end(one.make)] * n_envs)}
                for task, one in settings.items()
            }
        multiprocessing.get_context("forkserver").set_forkserver_preload(PRELOADED)
        # A bound method of plain settings: simulator processes unpickle it without importing LeRobot's registries.
        return {task: {0: _LazyAsyncVectorEnv([one.make] * n_envs)} for task, one in settings.items()}

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """Return the pipeline that adds `views` and declares depth to be metres, and the identity for actions."""
        views = [ViewSpec(name, asdict(view)).plain() for name, view in self._make_views().items()]
        depth_units: dict[str, Unit] = dict.fromkeys((key for key in self.features if key.endswith("_depth")), "m")
        step = ViewsProcessorStep(views=views, camera=self.camera.name, depth_units=depth_units)
        return PolicyProcessorPipeline(steps=[step]), PolicyProcessorPipeline(steps=[])
