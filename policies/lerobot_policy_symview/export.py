"""Export of policies to other runtimes, by torch.export, torch.onnx.export and torch.jit.trace.

```python
export_onnx(policy, preprocess(frame), "policy.onnx")
```

An exported policy maps preprocessed observations to actions in metres and radians: the crop, the drawn gripper, the
network and all scaling are part of it; the preprocessor, which makes the view, is not.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from lerobot_policy_symview.chunks import ChunkPolicy
from lerobot_policy_symview.configuration_chunks import wrist_key
from lerobot_policy_symview.policy import SymviewPolicy


class PolicyModule(nn.Module):
    """A policy as a module that maps observations to actions: LeRobot's `forward` returns the loss.

    Args:
        policy: is switched to evaluation mode.
    """

    def __init__(self, policy: SymviewPolicy):
        super().__init__()
        self.policy = policy.eval()

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """Map preprocessed observations, feature -> (B, ...), to actions (B, A) in metres and radians."""
        return self.policy.select_action(observation).detach()  # a trace does not record no_grad


def export_policy(policy: SymviewPolicy, observation: dict[str, Tensor]) -> torch.export.ExportedProgram:
    """Export a policy, for any batch size, with torch.export.

    Args:
        policy: a `symview_bc` policy, or the actor `symview_sacfd`; it is switched to evaluation mode.
        observation: an example (B, ...) of preprocessed observations. It fixes the images' size; features that the
            policy does not read are left out.

    Returns:
        The program of a `PolicyModule`; `example_inputs` has the features that it reads.

    Raises:
        ValueError: if the policy has a memory: its observations and planned actions are no part of a program.
    """
    if isinstance(policy, ChunkPolicy) and not policy.config.is_reactive:
        raise ValueError(
            f"only policies of one observation and one action can be exported; this {policy.name} has n_obs_steps="
            f"{policy.config.n_obs_steps} and horizon={policy.config.horizon}"
        )
    # two samples, since torch.export takes a size of 1 for a constant
    read = [*policy.scene.keys, *policy.scene.optional_keys, wrist_key(policy.config)]
    example = {key: torch.cat([observation[key][:1]] * 2) for key in read if key in observation}
    batch = torch.export.Dim("batch")
    return torch.export.export(PolicyModule(policy), (example,), dynamic_shapes=[{key: {0: batch} for key in example}])


def export_onnx(policy: SymviewPolicy, observation: dict[str, Tensor], file: str | Path) -> None:
    """Write a policy as an ONNX model, for any batch size; it needs the packages onnx and onnxscript.

    The model's inputs are named after the features that the policy reads, its output is `action`.

    Args:
        policy: as for `export_policy`. The graph of the encoder `point_cloud` is too large for the exporter.
        observation: as for `export_policy`.
        file: is overwritten.
    """
    program = export_policy(policy, observation)
    (example,), _ = program.example_inputs
    torch.onnx.export(
        program, f=file, input_names=list(example), output_names=["action"], external_data=False, verbose=False
    )
