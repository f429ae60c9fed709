"""LeRobot plugin: top-down views, equivariant policies and simulated tasks.

LeRobot imports this package by the name of its distribution. The import registers the policy and environment
configurations, a robot and the processor steps; networks and the simulator are imported when one is built.
"""

from lerobot_policy_symview.config_so101_sim import So101SimConfig
from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.configuration_symview_flow import SymviewFlowConfig
from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.encoders import register_encoder
from lerobot_policy_symview.env_symview import FetchEnvConfig, MetaWorldEnvConfig, SymviewEnvConfig
from lerobot_policy_symview.processor_allowlist import restrict_processor_steps
from lerobot_policy_symview.processor_joints import JointsProcessorStep, JointTargetsProcessorStep
from lerobot_policy_symview.processor_state import StateProcessorStep
from lerobot_policy_symview.processor_views import ViewsProcessorStep

restrict_processor_steps()

__all__ = [
    "FetchEnvConfig",
    "JointTargetsProcessorStep",
    "JointsProcessorStep",
    "MetaWorldEnvConfig",
    "So101SimConfig",
    "StateProcessorStep",
    "SymviewBcConfig",
    "SymviewEnvConfig",
    "SymviewFlowConfig",
    "SymviewSacfdConfig",
    "ViewsProcessorStep",
    "register_encoder",
]
