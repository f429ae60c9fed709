"""Configuration of the behaviour-cloning policy."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs.policies import PreTrainedConfig

from lerobot_policy_symview.configuration_chunks import ChunkConfig


@PreTrainedConfig.register_subclass("symview_bc")
@dataclass
class SymviewBcConfig(ChunkConfig):
    """Behaviour cloning on top-down views from freely placed cameras. The defaults are the paper's."""
