"""The processor step that computes views of an observation while a policy runs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import RobotObservation
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry
from torch import Tensor

from lerobot_symview import keys
from lerobot_symview.camera import Camera
from lerobot_symview.views import Frame, make_view
from lerobot_symview.workspace import Workspace

METRES_AT_MOST = 10.0


def metres(depth: Tensor) -> Tensor:
    """Return depth or heights in metres, whatever unit LeRobot delivered them in.

    `lerobot-train` converts a dataset's metres to millimetres unless told otherwise and does not say so in the batch,
    while environments yield metres. Nothing on a table is 10 m away, and a batch of millimetres that holds no value
    above 10 shows nothing higher than 1 cm, so the magnitude decides.
    """
    return depth / 1000.0 if depth.numel() and depth.abs().amax() > METRES_AT_MOST else depth


@dataclass
@ProcessorStepRegistry.register(name="symview_views")
class ViewsProcessorStep(ObservationProcessorStep):
    """Adds views of one camera to an observation; does nothing for a view that is already there.

    Args:
        views: name -> options of every view wanted, as for `lerobot_symview.views.make_view`.
        camera: the camera they are made from.
        workspace: constructor arguments of `Workspace`.
    """

    views: dict[str, dict[str, Any]] = field(default_factory=dict)
    camera: str = "side"
    workspace: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._views = {name: make_view(name, **options) for name, options in self.views.items()}
        arguments = dict(self.workspace)
        if "center" in arguments:
            arguments["center"] = tuple(arguments["center"])
        self._workspace = Workspace(**arguments)

    def observation(self, observation: RobotObservation) -> RobotObservation:
        """Return the observation with each missing view, as float32 (B, C, size, size) like any other image."""
        for view in self._views.values():
            wanted = [keys.view(self.camera, output) for output in view.outputs]
            if all(key in observation for key in wanted):
                continue
            images = [view.render(frame) for frame in self._frames(observation, view.needs_depth)]
            device = observation[keys.STATE].device
            for output, kind in view.outputs.items():
                stacked = torch.from_numpy(np.stack([image[output] for image in images])).to(device)
                observation[keys.view(self.camera, output)] = (
                    stacked.permute(0, 3, 1, 2).float() / 255 if kind == "rgb" else stacked[:, None]
                )
        return observation

    def get_config(self) -> dict[str, Any]:
        """Return the constructor's arguments, which a checkpoint stores as JSON."""
        return {"views": self.views, "camera": self.camera, "workspace": self.workspace}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Leave the declared features alone: the policy names what it needs."""
        return features

    def _frames(self, observation: RobotObservation, needs_depth: bool) -> list[Frame]:
        needed = [keys.rgb(self.camera), keys.intrinsics(self.camera), keys.world_from_cam(self.camera), keys.STATE]
        if needs_depth:
            needed.append(keys.depth(self.camera))
        missing = [key for key in needed if key not in observation]
        if missing:
            raise KeyError(f"the views {list(self.views)} need {missing}, the observation has {sorted(observation)}")
        arrays = {key: observation[key].detach().cpu() for key in needed}
        rgb = (arrays[keys.rgb(self.camera)] * 255).round().to(torch.uint8).permute(0, 2, 3, 1).numpy()
        depth = metres(arrays[keys.depth(self.camera)])[:, 0].numpy() if needs_depth else [None] * len(rgb)
        return [
            Frame(
                rgb=rgb[i],
                depth=depth[i],
                camera=Camera(
                    arrays[keys.intrinsics(self.camera)][i].numpy().reshape(3, 3),
                    arrays[keys.world_from_cam(self.camera)][i].numpy().reshape(4, 4),
                    *rgb.shape[1:3],
                ),
                workspace=self._workspace,
                gripper=arrays[keys.STATE][i].numpy(),
            )
            for i in range(len(rgb))
        ]
