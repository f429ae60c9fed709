"""The processors of `symview_flow`, where LeRobot looks for them."""

from lerobot_policy_symview.processor_pipelines import make_processors as make_symview_flow_pre_post_processors

__all__ = ["make_symview_flow_pre_post_processors"]
