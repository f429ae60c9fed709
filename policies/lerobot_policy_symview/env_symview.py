"""The simulators as LeRobot environments: `--env.type=symview`, `symview_metaworld`, `symview_fetch`."""

from __future__ import annotations

import multiprocessing
from dataclasses import asdict, dataclass, field, fields
from typing import Any, ClassVar

import gymnasium
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import _LazyAsyncVectorEnv, freeze_after_episode_end
from lerobot.processor import PolicyProcessorPipeline

from lerobot_policy_symview.processor_views import ViewsProcessorStep
from lerobot_symview import keys
from lerobot_symview.geometry.gripper_state import gripper_columns
from lerobot_symview.geometry.units import METRES
from lerobot_symview.runtime.flag_errors import FlagError, flag_errors
from lerobot_symview.runtime.view_flags import views_from_flags
from lerobot_symview.views import PerspectiveView, ReprojectedView, View, ViewSpec
from symview_sim.settings import WRIST_SIZE, EnvSettings, WorldSettings
from symview_sim.worlds.fetch import FetchSettings
from symview_sim.worlds.metaworld import MetaWorldSettings, check_task


@dataclass
class WorldEnvConfig(WorldSettings, EnvConfig):
    """What the environments of all simulators have in common. Derived classes also derive from their settings.

    Raises:
        FlagError: if a value is invalid; LeRobot's commands print the message.
    """

    fps: int = 0
    """Actions per second; it follows from the simulator."""
    views: list[ViewSpec] = field(default_factory=list)
    """Views of the first camera to add to each observation, for policies that do not render their own: names, or names
    with options, `[reproj, {name: persp, plane_height: 0.025}]`."""
    view_size: int | None = None
    """Rows and columns of the views for which `views` gives no size."""
    reproj: ReprojectedView = field(default_factory=ReprojectedView)
    """Options of the view `reproj`."""
    persp: PerspectiveView = field(default_factory=PerspectiveView)
    """Options of the view `persp`."""

    settings_class: ClassVar[type[WorldSettings]]
    preloaded: ClassVar[tuple[str, ...]] = ("lerobot.envs.utils", "symview_sim.table_env")
    """Modules of a simulator's process: the fork server imports them once, instead of six seconds in each process."""

    def __post_init__(self) -> None:
        with flag_errors("--env: "):
            self.settings()  # checks the fields for every task
            views = self._make_views()
        shapes: dict[str, tuple[int, ...]] = {}
        for camera in self.all_cameras:
            size = (camera.height, camera.width)
            shapes[keys.rgb(camera.name)] = (*size, 3)
            if self.depth:
                shapes[keys.depth(camera.name)] = (*size, 1)
            if self.has_labels:
                shapes[keys.segmentation(camera.name)] = (*size, 3)
        if self.has_wrist_camera:
            shapes[keys.rgb(keys.WRIST)] = (WRIST_SIZE, WRIST_SIZE, 3)
        for name, view in views.items():
            if view.needs_depth and not self.depth:
                raise FlagError(f"the view {name!r} needs depth: keep --env.depth=true or use 'persp'")
            if view.memory:
                raise FlagError(
                    f"the view {name!r} with memory=true needs to know when an episode starts, which LeRobot tells the "
                    "policy alone: leave it to a symview policy, or use memory=false"
                )
            names = [camera.name for camera in self.all_cameras]
            unknown = [camera for camera in view.cameras if camera not in names]
            if unknown:
                raise FlagError(
                    f"the view {name!r} merges {', '.join(unknown)}, but --env.camera and --env.more_cameras are "
                    f"{', '.join(names)}"
                )
            for output, kind in view.outputs.items():
                shapes[keys.view(self.camera.name, output)] = (view.size, view.size, 3 if kind == "rgb" else 1)
        self.features = {
            keys.ACTION: PolicyFeature(FeatureType.ACTION, (len(self.action_names),)),
            keys.STATE: PolicyFeature(FeatureType.STATE, (len(self.state_names),)),
            **{key: PolicyFeature(FeatureType.VISUAL, shape) for key, shape in shapes.items()},
        }
        self.features_map = {key: key for key in self.features}
        if self.fps not in (0, self.actions_per_second):
            raise FlagError(f"--env.fps={self.fps}: the simulator takes {self.actions_per_second} actions a second")
        self.fps = self.actions_per_second

    def _make_views(self) -> dict[str, View]:
        options: dict[str, View] = {"reproj": self.reproj, "persp": self.persp}
        return views_from_flags(self.views, self.view_size, options) if self.views else {}

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """The fields of the simulator's settings except the task."""
        names = [setting.name for setting in fields(self.settings_class) if setting.name != "task"]
        return {name: getattr(self, name) for name in names}

    @property
    def tasks(self) -> list[str]:
        """Names of the tasks."""
        return list(self.task_names()) if self.task == "all" else [name.strip() for name in self.task.split(",")]

    def settings(self) -> dict[str, WorldSettings]:
        """Return task -> settings."""
        return {task: self.settings_class(task=task, **self.gym_kwargs) for task in self.tasks}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
        """Return `{task: {0: a vector environment of n_envs}}`.

        Asynchronous environments, used only for `n_envs` above 1, start their processes at the first reset, so that a
        suite runs the processes of only one task at a time.
        """
        if not use_async_envs or n_envs == 1:
            return {
                task: {0: gymnasium.vector.SyncVectorEnv([freeze_after_episode_end(settings.make)] * n_envs)}
                for task, settings in self.settings().items()
            }
        multiprocessing.get_context("forkserver").set_forkserver_preload(list(self.preloaded))
        # A bound method of plain settings: simulator processes unpickle it without importing LeRobot's registries.
        return {task: {0: _LazyAsyncVectorEnv([settings.make] * n_envs)} for task, settings in self.settings().items()}

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """Return the preprocessor, which adds `views` and declares depth in metres, and an empty postprocessor."""
        views = [ViewSpec(name, asdict(view)).plain() for name, view in self._make_views().items()]
        depth_units: dict[str, float] = dict.fromkeys((key for key in self.features if key.endswith("_depth")), METRES)
        step = ViewsProcessorStep(
            views=views,
            camera=self.camera.name,
            workspace=asdict(self.workspace),
            gripper=gripper_columns(self.state_names) or [],
            depth_units=depth_units,
        )
        return PolicyProcessorPipeline(steps=[step]), PolicyProcessorPipeline(steps=[])


@EnvConfig.register_subclass("symview")
@dataclass
class SymviewEnvConfig(EnvSettings, WorldEnvConfig):
    """PyBullet tabletop tasks, observed by freely placed RGBD cameras.

    Raises:
        FlagError: if a value is invalid; LeRobot's commands print the message.
    """

    task: str = "block_picking"
    """Name of the task, such as `block_picking`; several names separated by commas; or `all`."""

    settings_class = EnvSettings
    preloaded = ("lerobot.envs.utils", "symview_sim.env")


@EnvConfig.register_subclass("symview_metaworld")
@dataclass
class MetaWorldEnvConfig(MetaWorldSettings, WorldEnvConfig):
    """Meta-World's tasks, observed by freely placed RGBD cameras.

    Raises:
        FlagError: if a value is invalid; LeRobot's commands print the message.
    """

    task: str = "push-v3"
    """Name of the task, such as `push-v3`; several names separated by commas; or `all`."""

    settings_class = MetaWorldSettings

    def __post_init__(self) -> None:
        super().__post_init__()
        with flag_errors("--env: "):
            for task in self.tasks:
                check_task(task)


@EnvConfig.register_subclass("symview_fetch")
@dataclass
class FetchEnvConfig(FetchSettings, WorldEnvConfig):
    """FetchPush, observed by freely placed RGBD cameras.

    Raises:
        FlagError: if a value is invalid; LeRobot's commands print the message.
    """

    settings_class = FetchSettings
