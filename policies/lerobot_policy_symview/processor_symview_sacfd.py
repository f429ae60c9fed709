"""The processors of `symview_sacfd`, where LeRobot looks for them."""

from lerobot_policy_symview.processor_pipelines import make_processors as make_symview_sacfd_pre_post_processors

__all__ = ["make_symview_sacfd_pre_post_processors"]
