"""The simulated tasks as a LeRobot environment: `--env.type=symview`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gymnasium
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.processor import PolicyProcessorPipeline

from lerobot_policy_symview.processor_views import ViewsProcessorStep
from lerobot_symview import keys
from lerobot_symview.placement import CameraSpec
from lerobot_symview.views import make_view


@EnvConfig.register_subclass("symview")
@dataclass
class SymviewEnvConfig(EnvConfig):
    """PyBullet tabletop tasks seen by a freely placed RGBD camera."""

    task: str = "block_picking"
    """Which task, such as `block_picking`."""
    fps: int = 3
    """Actions per second of a robot that takes as long as the simulated one."""
    robot: str = "panda"
    """Which arm."""
    camera: CameraSpec = field(default_factory=CameraSpec)
    """Where the camera stands and what it sees."""
    oracle: bool = False
    """Add the camera `top`, which looks straight down and does not see the arm."""
    views: list[str] = field(default_factory=list)
    """Views to add to each observation, for policies that do not compute their own."""
    view_size: int = 152
    """Rows and columns of those views."""
    start_jitter: float = 0.0
    """Largest random displacement of the gripper's start position per axis, metres."""
    max_steps: int = 50
    """Actions per episode."""

    def __post_init__(self) -> None:
        names = [self.camera.name, *(["top"] if self.oracle else [])]
        shapes = {keys.rgb(name): (self.camera.size, self.camera.size, 3) for name in names}
        shapes |= {keys.depth(name): (self.camera.size, self.camera.size, 1) for name in names}
        for view in self.views:
            for output, kind in make_view(view, size=self.view_size).outputs.items():
                key = keys.view(self.camera.name, output)
                shapes[key] = (self.view_size, self.view_size, 3 if kind == "rgb" else 1)
        self.features = {
            keys.ACTION: PolicyFeature(FeatureType.ACTION, (len(keys.ACTION_NAMES),)),
            keys.STATE: PolicyFeature(FeatureType.STATE, (len(keys.STATE_NAMES),)),
            **{key: PolicyFeature(FeatureType.VISUAL, shape) for key, shape in shapes.items()},
        }
        self.features_map = {key: key for key in self.features}

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Settings of the simulated environment, see `symview_sim.settings.EnvSettings`."""
        names = ("task", "robot", "camera", "oracle", "start_jitter", "max_steps")
        return {name: getattr(self, name) for name in names}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
        """Return `{"symview": {0: a vector environment of n_envs}}`; asynchronous only where it has several."""
        from symview_sim.settings import EnvSettings

        # A bound method of plain settings: simulator processes unpickle it without importing LeRobot's registries.
        make_one = freeze_after_episode_end(EnvSettings(**self.gym_kwargs).make)
        vector: gymnasium.vector.VectorEnv
        if use_async_envs and n_envs > 1:
            vector = gymnasium.vector.AsyncVectorEnv([make_one] * n_envs, context="forkserver")
        else:
            vector = gymnasium.vector.SyncVectorEnv([make_one] * n_envs)
        return {self.type: {0: vector}}

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """Return the pipeline that adds `views`, and the identity for actions."""
        options = {view: {"size": self.view_size} for view in self.views}
        step = ViewsProcessorStep(views=options, camera=self.camera.name)
        return PolicyProcessorPipeline(steps=[step] if options else []), PolicyProcessorPipeline(steps=[])
