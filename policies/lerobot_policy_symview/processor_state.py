"""The processor step that reads states of other conventions as ours."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs.types import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import RobotObservation
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry

from lerobot_symview import keys
from lerobot_symview.geometry.state_reader import StateReader


@dataclass
@ProcessorStepRegistry.register(name="symview_state")
class StateProcessorStep(ObservationProcessorStep):
    """Reads `observation.state` as x, y, z relative to the workspace's centre, yaw, aperture, and what else it has.

    Args:
        names: of the state's dimensions; without names, the state is kept unchanged.
        origin: the workspace's centre on the table in the frame of the state's positions, metres.
    """

    names: list[str] = field(default_factory=list)
    origin: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def __post_init__(self) -> None:
        if len(self.origin) != 3 or not all(isinstance(name, str) for name in self.names):
            raise ValueError(f"expected names and an origin of three numbers, got {self.names} and {self.origin}")
        x, y, z = map(float, self.origin)
        self._reader = StateReader(tuple(self.names), (x, y, z))

    def observation(self, observation: RobotObservation) -> RobotObservation:
        """Return the observation with its state (B, N) as it is read.

        Raises:
            ValueError: if the state has another number of dimensions than `names`.
        """
        if keys.STATE not in observation or not self._reader.converts:
            return observation
        state = observation[keys.STATE]
        if state.shape[-1] != len(self.names):
            raise ValueError(
                f"{keys.STATE} has {state.shape[-1]} dimensions, the policy was trained with {len(self.names)}: "
                f"{', '.join(self.names)}"
            )
        return observation | {keys.STATE: self._reader.read(state)}

    def get_config(self) -> dict[str, Any]:
        """Return the constructor's arguments that a checkpoint stores as JSON."""
        return {"names": self.names, "origin": self.origin}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Keep the declared features unchanged: they are the robot's."""
        return features
