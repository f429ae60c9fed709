"""Configuration of the behaviour-cloning policy."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lerobot.configs.policies import PreTrainedConfig

from lerobot_policy_symview.configuration_chunks import ChunkConfig


@PreTrainedConfig.register_subclass("symview_bc")
@dataclass
class SymviewBcConfig(ChunkConfig):
    """Behaviour cloning on top-down views from freely placed cameras. The defaults are the paper's."""

    aperture_noise: float = 0.0
    """Standard deviation of Gaussian noise on the state's `aperture` dimensions in training, in their unit. An expert
    opens the gripper to exactly the same aperture every time, a policy does not: without noise, the policy's own
    apertures are out of distribution."""

    def check(self) -> None:
        """Check the fields of all policies, those of chunks, and those of behaviour cloning."""
        super().check()
        if not 0 <= self.aperture_noise < math.inf:
            raise ValueError(f"--policy.aperture_noise must be finite and at least 0, got {self.aperture_noise}")
        if self.aperture_noise and not self.states.of_type("aperture"):
            raise ValueError(
                f"--policy.aperture_noise={self.aperture_noise} needs a dimension `aperture` in "
                f"--policy.state_symmetry, got {self.state_symmetry}"
            )
